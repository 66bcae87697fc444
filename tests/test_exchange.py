"""Operators of the exchange between ranks, against their plain formulation (tests/test_over_ranks.py: all of it)."""

import pytest
import torch
from diff_gaussian_rasterization.fakes import ABSOLUTE_VALUES, MOMENT_VALUES, RAY_VALUES, SPLAT_VALUES
from rasterizer_tools import BOTH_AND_GPU, moved_by_a_word, ops
from torch import Tensor

from groundwork.host.read_later import read_later

LARGE = 20_000  # more than a thread of the CPU takes at once, and no multiple of anything


def reach_of(kind: str, device: str) -> tuple[Tensor, Tensor, Tensor]:
    """Rectangles, tile counts and the limits of bands, of which one is empty."""
    count = {"none": 0, "one": 1}.get(kind, LARGE)
    generator = torch.Generator().manual_seed(count)
    rects = torch.randint(-(2**31), 2**31, (count, 4), generator=generator, dtype=torch.int64)
    rects[:, 1] = torch.randint(0, 20, (count,), generator=generator)
    rects[:, 3] = rects[:, 1] + torch.randint(1, 4, (count,), generator=generator)
    tile_counts = torch.randint(0, 3, (count,), generator=generator)
    if kind == "unseen":
        tile_counts.zero_()
    first, end = ([0, 7, 2**30, 8], [7, 8, -1, 24]) if kind != "many bands" else (range(24), range(1, 25))
    limits = torch.tensor([[*first], [*end]])
    return tuple(t.to(device, torch.int32) for t in (rects, tile_counts, limits))


def recorded_by_torch(rects: Tensor, tile_counts: Tensor, limits: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Records by band, Gaussian of each record, and its number by Gaussian and then by band."""
    first, end = limits[:, :, None]
    reached = (rects[:, 1] < end) & (rects[:, 3] > first) & (tile_counts > 0)
    band, gaussian = reached.nonzero().unbind(1)
    numbers = reached.T.reshape(-1).cumsum(0) - 1
    return reached.sum(1), gaussian, numbers[band + len(reached) * gaussian].int()


def with_empty(counts: Tensor, empty: list[int]) -> Tensor:
    """The counts of `list_records`, and behind them so many empty records for each band."""
    return torch.cat((counts, counts.new_tensor([*empty, sum(empty)])[:, None]), 1)


@BOTH_AND_GPU
@pytest.mark.parametrize("values", [SPLAT_VALUES, SPLAT_VALUES + RAY_VALUES])
@pytest.mark.parametrize("kind", ["none", "one", "unseen", "some", "many bands"])
def test_records_are_counted_and_listed(kind, values, device, dtype):
    reach = reach_of(kind, device)
    count = len(reach[0])
    splats, depths = (
        torch.rand(count, values, device=device, dtype=dtype),
        torch.rand(count, device=device, dtype=dtype),
    )
    numbers, gaussians, places = recorded_by_torch(*reach)
    counts = ops.list_records(*reach)[0]
    assert torch.equal(counts[:-1].sum(1), numbers) and torch.equal(counts[-1], counts[:-1].sum(0))
    empty = [(3 * band + 1) % 4 for band in range(len(numbers))]
    counts, total = with_empty(counts, empty), len(gaussians) + sum(empty)
    _, *found = ops.list_records(*reach, counts, splats, depths, total)
    filled = found[0] < count
    assert torch.equal(found[0][filled], gaussians) and torch.equal(found[1][filled], places)
    assert found[1][~filled].tolist() == list(range(len(gaussians), total))
    ends = torch.tensor([int(n) + k for n, k in zip(numbers, empty, strict=True)]).cumsum(0).tolist()
    assert (~filled).nonzero()[:, 0].tolist() == [
        e - k for e, n in zip(ends, empty, strict=True) for k in range(n, 0, -1)
    ]
    for one, other in zip(found[2:], (splats, depths, *reach[:2]), strict=True):
        assert torch.equal(one[filled], other[gaussians]) and not one[~filled].any()
    for room in (total // 2, total + 7):
        _, *part = ops.list_records(*reach, counts, splats, depths, room)
        for one, other in zip(part, found, strict=True):
            assert len(one) == room and torch.equal(one[:total], other[:room])
    assert kind != "some" or len(gaussians) > LARGE / 2


def some_counts(kind: str) -> Tensor:
    generator = torch.Generator().manual_seed(5)
    counts = torch.randint(4, (5_000,), generator=generator, dtype=torch.int32)
    if kind == "giants":
        counts[[0, 1700, 4999]] = torch.tensor([9_000, 4_001, 3], dtype=torch.int32)
    elif kind == "hardly any":
        counts *= torch.rand(5_000, generator=generator) < 0.01
    return {"none": counts[:0], "one": counts[:1].fill_(3), "no rows": counts.fill_(0)}.get(kind, counts)


def some_runs(kind: str, values: int, device: str, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Numbers of rows, and the rows."""
    counts = some_counts(kind)
    rows = torch.randn(int(counts.sum()), values, generator=torch.Generator().manual_seed(2))
    return counts.to(device), rows.to(device, dtype)


VALUES = pytest.mark.parametrize("values", [MOMENT_VALUES, MOMENT_VALUES + ABSOLUTE_VALUES])
RUNS = pytest.mark.parametrize("kind", ["none", "one", "no rows", "hardly any", "many", "giants"])


@BOTH_AND_GPU
@VALUES
@RUNS
def test_runs_are_added_up(kind, values, device, dtype):
    counts, rows = some_runs(kind, values, device, dtype)
    run = torch.arange(len(counts), device=device)
    sums = torch.zeros(len(counts), values, device=device, dtype=torch.float64)
    sums.index_add_(0, run.repeat_interleave(counts), rows.double())
    found = ops.sum_runs(rows, counts, torch.ones_like(counts), len(counts) + 3)
    assert found.shape == (len(counts) + 3, values) and found.dtype == dtype
    torch.testing.assert_close(found[:-3].double(), sums, rtol=1e-5, atol=1e-4 if dtype == torch.float32 else 1e-9)
    assert torch.equal(found[:-3][counts == 1], rows[(counts == 1).repeat_interleave(counts)])
    # Some keep all rows, and some none.
    kept = torch.where(run % 3 == 0, counts, (run % 3 == 1).int())
    again = ops.sum_runs(rows, counts, kept, int(kept.sum()))
    whole = ((run % 3 == 0) & (kept != 1)).repeat_interleave(kept)
    assert torch.equal(again[whole], rows[((run % 3 == 0) & (kept != 1)).repeat_interleave(counts)])
    assert torch.equal(again[~whole], found[:-3][kept == 1])
    for same in (torch.cat((rows, rows), 1)[:, values:], moved_by_a_word(rows)):
        assert torch.equal(ops.sum_runs(same, counts, kept, int(kept.sum())), again)
    # In another order.
    order = (run % 7).argsort(stable=True)
    places = torch.empty_like(counts).index_copy_(0, order, run.int())
    moved = ops.sum_runs(rows, counts, kept, int(kept.sum()), places)
    pieces = again.split(kept.tolist())
    assert torch.equal(moved, torch.cat([again[:0], *(pieces[place] for place in order.tolist())]))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no NVIDIA GPU")
def test_numbers_are_read_before_later_work_is_done():
    numbers, end = torch.arange(3, device="cuda"), torch.cuda.Event()
    torch.cuda.synchronize()
    read = read_later(numbers)
    torch.cuda._sleep(2_000_000_000)
    end.record()
    assert read() == [0, 1, 2] and not end.query()
