"""A training over ranks: the model and the losses of one process to the byte, and few words between the ranks."""

import sys
from collections import Counter
from pathlib import Path

import pytest
import torch
from processes import in_ranks

import train
from splatting.distributed import several
from splatting.distributed.ranks import ranks
from splatting.training.steps.fused import FusedStep

COLLECTIVES = ("all_gather", several.ALL_GATHER, "all_gather_object", "all_reduce", "all_to_all_single", "barrier",
               "broadcast", "broadcast_object_list")  # fmt: skip
# What a step costs that changes no rows. Each call waits for the slowest rank: add none without need.
STEP = {
    several.ALL_GATHER: 1,  # numbers of splats that each rank sends, with signals and flags
    "all_reduce": 1,  # sums of the loss
    "all_to_all_single": 4,  # splats, rows around a band; numbers of gradient rows of each splat, the rows
    "broadcast": 1,  # the photo
}
# the image in place of the rows around a band
WHOLE_STEP = {several.ALL_GATHER: 1, "all_to_all_single": 4, "broadcast": 1}
FIRST = "broadcast_object_list"  # once for each photo: its shape


def _train(scene: str, out: str, options: list[str]) -> tuple[list[bytes], list[dict[str, int]], bytes]:
    """Train: the losses, the collective calls of fused steps, and the model."""
    torch.set_num_threads(1)
    calls, losses, counted = Counter(), [], []
    measure, advance, out = FusedStep.measure, FusedStep.advance, f"{out}_{ranks().size}"

    def counting(name: str) -> None:
        call = getattr(several.dist, name)

        def counted_call(*args: object, **kwargs: object) -> object:
            calls[name] += 1
            return call(*args, **kwargs)

        setattr(several.dist, name, counted_call)

    def measured(self: FusedStep, step: object) -> tuple:
        calls.clear()
        found = measure(self, step)
        losses.append(torch.stack([x for x in found[1] if x is not None]).numpy().tobytes())
        return found

    def advanced(self: FusedStep, *args: object) -> None:
        advance(self, *args)
        counted.append(dict(calls))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdout", sys.stdout)  # training stamps it
        patch.setattr(FusedStep, "measure", measured)
        patch.setattr(FusedStep, "advance", advanced)
        for name in COLLECTIVES:
            patch.setattr(several.dist, name, getattr(several.dist, name))  # so that it is undone
            counting(name)
        words = ["-s", scene, "-m", out, "--iterations", "30", "--no_curve", "--disable_viewer", "--quiet"]
        density = ["--densify_from_iter", "5", "--densification_interval", "10", "--densify_grad_threshold", "5e-5"]
        train.main([*words, *density, "--test_iterations", "-1", *options])
    model = Path(out) / "point_cloud/iteration_30/point_cloud.ply"
    return losses, counted, model.read_bytes() if ranks().first else b""


@pytest.mark.parametrize(
    ("size", "options", "cost"),
    [
        (3, ["-r", "96", "--strategy", "adc"], STEP),
        (2, ["-r", "50", "--eval", "--train_test_exp"], WHOLE_STEP),  # exposures need the whole image
    ],
)
def test_ranks_train_as_one_process(colmap_scene, tmp_path, size, options, cost):
    alone = _train(str(colmap_scene), str(tmp_path / "model"), options)
    found = in_ranks(size, _train, str(colmap_scene), str(tmp_path / "model"), options)
    assert found[0][2] == alone[2] and len(alone[0]) > 20
    for losses, calls, _ in found:
        assert losses == alone[0]
        assert 10 < sum(each.pop(FIRST, 0) for each in calls) <= 20
        found_bands = cost | {several.ALL_GATHER: 2}
        assert 10 < sum(each == found_bands for each in calls) <= 20  # at a view's first visit
        assert len(calls) > 20 and all(each in (cost, found_bands) for each in calls), calls
