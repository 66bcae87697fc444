"""Messages between the processes of a training, and how few of them a step needs."""

import sys
from collections import Counter
from pathlib import Path

import pytest
import torch
from forks import fork
from processes import in_ranks

import train
from groundwork.ranks import process_group
from groundwork.ranks.ranks import ALONE, Ranks, ranks
from splatting.faster.fused import FusedStep
from splatting.iteration import Iteration
from splatting.run import Run


def _talk() -> dict[str, object]:
    here = ranks()
    rows = torch.arange(6.0).view(2, 3)[: here.rank] + 10 * here.rank
    parts = [torch.full((here.rank + d, 2), 10 * here.rank + d, dtype=torch.int32) for d in range(here.size)]
    bits = [torch.ones(d, dtype=torch.bool) for d in range(here.size)]
    return {
        "numbers": here.all_gather_host_ints(here.rank, 7).tolist(),
        "agreed": _agreed(here),
        "shared": [here.broadcast_object({"rank": here.rank}, *holder) for holder in ((), (1,))],
        "handed": _handed(here),
        "parts": [part.tolist() for part in here.exchange(parts)],
        "bits": [part.tolist() for part in here.exchange(bits)],
        "rows": here.all_gather_rows(rows).tolist(),
        "nothing": here.all_gather_rows(torch.empty(3, 0)).shape,
        "sent": _listed(here.send(torch.arange(3), [0] * (here.size - 1) + [3])),
        "known": _listed(here.send(torch.full((here.size,), here.rank), [1] * here.size, [1] * here.size)),
        "known rows": here.all_gather_rows(rows, [min(r, 2) for r in range(here.size)]).tolist(),
        "table": here.all_gather(torch.tensor([[here.rank, 0.5]])).tolist(),
        "added": here.all_reduce_sum(
            torch.tensor([0.1, 0.0, 7.0 * here.rank], dtype=torch.float64) * (here.rank == 1)
        ).tolist(),
        "before": here.offset_and_total(here.rank + 1),
        "anyone": (here.any_rank(here.rank == 1), here.any_rank(False)),
    }


def _handed(here: Ranks) -> list[list[float]]:
    """Values of rank 1 in two types, of which other ranks know the shape."""
    kept = [torch.tensor([1, 2, 3], dtype=torch.uint8), torch.tensor([0.5, 9.0, 2.5, 9.0])[::2]]
    mine = [values if here.rank == 1 else None for values in kept]
    return [
        here.broadcast_from(1, x, like.shape, like.dtype, like.device).tolist()
        for x, like in zip(mine, kept, strict=True)
    ]


def _agreed(here: Ranks) -> list:
    """Numbers by rank, a flag that rank 1 has raised, and what was posted: with the numbers, and without any."""
    here.flag = torch.tensor([5 if here.rank == 1 else 0])
    here.piggyback(int(here.rank == 1), 2 * here.rank)
    found = [here.all_gather_ints(torch.tensor([here.rank, 7])), here.flag.item(), list(here.latest())]
    here.all_gather_ints(torch.tensor([0]))  # as a second view of an iteration
    found.append(list(here.latest()))
    here.flag.fill_(6 + here.rank)
    here.piggyback(0, 3)
    return [*found, list(here.latest()), here.flag.item()]


def _listed(sent: tuple[torch.Tensor, list[int]]) -> tuple[list, list[int]]:
    return sent[0].tolist(), sent[1]


@pytest.mark.parametrize("size", [2, 3])
def test_ranks_tell_each_other(size):
    for rank, said in enumerate(in_ranks(size, _talk)):
        assert said["numbers"] == [[other, 7] for other in range(size)]
        last = size - 1
        assert said["agreed"] == [[[other, 7] for other in range(size)], 5, *[[1, 2 * last]] * 2, [0, 3], 6 + last]
        assert said["shared"] == [{"rank": 0}, {"rank": 1}]
        assert said["handed"] == [[1, 2, 3], [0.5, 2.5]]
        assert said["parts"] == [[[10 * other + rank] * 2] * (other + rank) for other in range(size)]
        assert said["bits"] == [[True] * rank] * size
        rows = [[10.0 * r + 3 * i + j for j in range(3)] for r in range(size) for i in range(min(r, 2))]
        assert said["rows"] == rows
        assert said["nothing"] == (3 * size, 0)
        assert said["sent"] == ([0, 1, 2] * size if rank == size - 1 else [], [3 * (rank == size - 1)] * size)
        assert said["known"] == (list(range(size)), [1] * size)
        assert said["known rows"] == rows
        assert said["table"] == [[[other, 0.5]] for other in range(size)]
        assert said["added"] == [0.1, 0.0, 7.0]
        assert said["before"] == (sum(range(rank + 1)), size * (size + 1) // 2)
        assert said["anyone"] == (True, False)


def test_a_process_by_itself_is_all_ranks():
    rows = torch.ones(3, 2)
    assert ranks() is ALONE and ALONE.first and not ALONE.several
    assert ALONE.all_gather_rows(rows) is rows and ALONE.exchange([rows]) == [rows]
    assert ALONE.all_gather_host_ints(4, 5).tolist() == [[4, 5]] and ALONE.offset_and_total(3) == (0, 3)
    assert (
        ALONE.send(rows, [3]) == (rows, [3])
        and ALONE.all_reduce_sum(rows) is rows
        and ALONE.all_gather(rows).shape == (1, 3, 2)
    )
    assert ALONE.broadcast_object(rows) is rows and ALONE.any_rank(True) and not ALONE.any_rank(False)


_LEAVE = """
from pathlib import Path
import torch.distributed as dist
from groundwork.ranks.process_group import SeveralRanks
dist.init_process_group("gloo", store=dist.HashStore(), rank=0, world_size=1)
ranks = SeveralRanks()
ranks.itself = ranks
threads = lambda: [name.read_text() for name in Path("/proc/self/task").glob("*/comm")]
assert ranks.all_gather_host_ints(7).tolist() == [[7]] and any("gloo" in name for name in threads())
ranks.leave()
assert not any("gloo" in name for name in threads())
"""


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="the names of threads are read from /proc")
def test_no_thread_of_a_group_is_left_behind():
    """Such a thread would end with Python, whose lock it may wait for, and abort the process."""
    done = fork(_LEAVE)
    assert done.status == 0, done.stderr


# The calls of a step


COLLECTIVES = ("all_gather", process_group.ALL_GATHER, "all_gather_object", "all_reduce", "all_to_all_single",
               "barrier", "broadcast", "broadcast_object_list")  # fmt: skip
# What a step costs that changes no rows. Each call waits for the slowest rank: add none without need.
STEP = {
    process_group.ALL_GATHER: 1,  # numbers of splats that each rank sends, with signals and flags
    "all_reduce": 1,  # sums of the loss
    # Splats in four, which follow each other; rows around a band; numbers of gradient rows of each splat, the rows.
    "all_to_all_single": 7,
    "broadcast": 1,  # the photo
}
# the image in place of the rows around a band
WHOLE_STEP = {process_group.ALL_GATHER: 1, "all_to_all_single": 7, "broadcast": 1}
FIRST = "broadcast_object_list"  # once for each photo: its shape


def _train(scene: str, out: str, options: list[str]) -> list[dict[str, int]]:
    """Train: the collective calls of steps that change no rows."""
    torch.set_num_threads(1)
    calls, counted = Counter(), []
    measure, advance = FusedStep.measure, FusedStep.advance

    def counting(name: str) -> None:
        call = getattr(process_group.dist, name)

        def counted_call(*args: object, **kwargs: object) -> object:
            calls[name] += 1
            return call(*args, **kwargs)

        setattr(process_group.dist, name, counted_call)

    def measured(self: FusedStep, step: object) -> tuple:
        calls.clear()
        return measure(self, step)

    def advanced(self: FusedStep, at: Iteration, *args: object) -> None:
        advance(self, at, *args)
        counted.extend([] if at.changes or at.last else [dict(calls)])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdout", sys.stdout)  # training stamps it
        patch.setattr(Run, "_raises_degree", lambda *_: 0)  # such steps take others
        patch.setattr(FusedStep, "measure", measured)
        patch.setattr(FusedStep, "advance", advanced)
        for name in COLLECTIVES:
            patch.setattr(process_group.dist, name, getattr(process_group.dist, name))  # so that it is undone
            counting(name)
        words = ["-s", scene, "-m", out, "--iterations", "30", "--no_curve", "--disable_viewer", "--quiet"]
        density = ["--densify_from_iter", "5", "--densification_interval", "10", "--densify_grad_threshold", "5e-5"]
        train.main([*words, *density, "--test_iterations", "-1", *options])
    return counted


@pytest.mark.parametrize(
    ("size", "options", "cost"),
    [
        (3, ["-r", "96", "--strategy", "adc"], STEP),
        (2, ["-r", "50", "--eval", "--train_test_exp"], WHOLE_STEP),  # exposures need the whole image
        (2, ["-r", "50", "--eval", "--refine_poses"], STEP | {"all_to_all_single": 8}),  # sums of the pose's gradient
    ],
)
def test_a_step_takes_few_collective_calls(colmap_scene, tmp_path, size, options, cost):
    for calls in in_ranks(size, _train, str(colmap_scene), str(tmp_path / "model"), options):
        assert 10 < sum(each.pop(FIRST, 0) for each in calls) <= 20
        found_bands = cost | {process_group.ALL_GATHER: 2}
        assert 10 < sum(each == found_bands for each in calls) <= 20  # at a view's first visit
        assert len(calls) > 20 and all(each in (cost, found_bands) for each in calls), calls
