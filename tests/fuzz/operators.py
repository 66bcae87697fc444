"""Calls of every operator of the three extensions, and changes of one tensor that must end in an error."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import torch
from fused_ssim.backend import OPERATORS as ssim
from rasterizer_tools import few, ops, scene_arguments
from simple_knn.backend import OPERATORS as knn
from torch import Tensor

from benchmarks.workloads.splat_scenes import on_device, settings

Call = tuple[Any, list]  # operator, arguments


def sound_calls(device: str = "cpu", dtype: torch.dtype = torch.float32) -> dict[str, Call]:
    """One call of each operator, by name. Operators that know no float64 get float32."""
    raw, size = few(dtype=dtype)
    raw, camera = {name: t.to(device) for name, t in raw.items()}, on_device(settings(**size), device)
    rand, single = partial(torch.rand, device=device, dtype=dtype), partial(torch.rand, device=device)
    integers = partial(torch.tensor, device=device, dtype=torch.int32)
    height, width, background = camera.image_height, camera.image_width, camera.bg.to(dtype)
    scene = list(scene_arguments(raw, camera))
    splats, depths, rects, counts, _ = ops.project(*scene)
    instances, ranges, *slots = ops.bin(splats, depths, rects, counts, height, width, True)
    *planes, last, layers = ops.blend(splats, instances, ranges, background, height, width, True, True)
    state, planes = [splats, instances, ranges, *slots, background, last, planes[1]], [*map(torch.ones_like, planes)]
    if not len(layers):
        layers = rand(5 * 256)  # as a GPU makes them of few instances
    rows = ops.blend_rows(*state, *planes, layers)
    packed = integers([[0] * (11 * dtype.itemsize // 4 + 5)] * len(counts))
    reach = [rects, counts, integers([[0, 2], [2, 5]])]
    recorded = ops.count_records(*reach)
    wanted = [True, True, True, True, True, False, False, True, True]
    sums = list(ops.rows_vjp(*scene, splats, counts, *rows, wanted))
    lists = [[rand(3, 3), rand(2, 5)] for _ in range(4)]
    guard = [rand(()), torch.zeros(1, dtype=torch.int64, device=device), 3]
    adam = [*lists, [torch.tensor(1.0), torch.tensor(7.0)], [0.1, 0.2], 0.9, 0.99, 1e-8, [2, -1], *guard]
    seen = torch.tensor([True, False, True], device=device)
    sparse = [*(rand(3, 3) for _ in range(4)), seen, 0.1, 0.9, 0.99, 1e-8, -1]
    statistics = [single(3), single(3, 1), single(3, 1), integers([0, 3, 5])]
    one, two, gradient = rand(3, 20, 20), rand(3, 20, 20), torch.ones((), dtype=dtype, device=device)
    kept = ssim.l1_ssim(one, two, False, True)[2]
    step = _step(raw)
    return {
        "project": (ops.project, scene),
        "bin": (ops.bin, [splats, depths, rects, counts, height, width, True]),
        "blend": (ops.blend, [splats, instances, ranges, background, height, width, True, True]),
        "pack_splats_": (
            ops.pack_splats_,
            [packed, splats, depths, rects, counts, torch.arange(len(counts), device=device)],
        ),
        "unpack_splats": (ops.unpack_splats, [packed, splats]),
        "count_records": (ops.count_records, reach),
        "list_records": (ops.list_records, [*reach, recorded, int(recorded[-1].sum())]),
        "sum_runs": (ops.sum_runs, [*rows, rows[1].clamp_max(1), int(rows[1].count_nonzero())]),
        "sum_parts": (ops.sum_parts, [rows[1], [1, 0, len(rows[1]) - 1]]),
        "move_runs": (ops.move_runs, [*rows, torch.arange(len(counts), device=device).int().flip(0)]),
        "blend_vjp": (ops.blend_vjp, [*state, *planes]),
        "blend_rows": (ops.blend_rows, [*state, *planes, layers, True]),
        "rows_vjp": (ops.rows_vjp, [*scene, splats, counts, *rows, wanted]),
        "rows_vjp_add_": (ops.rows_vjp_add_, [*scene, splats, counts, *rows, sums]),
        "rows_vjp_step_": (ops.rows_vjp_step_, [*scene, splats, counts, *rows, *step, *guard]),
        "project_vjp": (ops.project_vjp, [*scene, counts, ops.blend_vjp(*state, *planes), wanted]),
        "rasterize": (ops.rasterize, [torch.zeros_like(raw["means"]), *scene, background, True, True]),
        "rasterize_vjp": (ops.rasterize_vjp, [*scene, *state, *planes, counts, layers, wanted]),
        "rasterize_vjp_step_": (ops.rasterize_vjp_step_, [*scene, *state, *planes, counts, layers, *step, *guard]),
        "mark_visible": (ops.mark_visible, [raw["means"], scene[8]]),
        "decisive": (ops.decisive, [splats, instances, ranges, last]),
        "adam_": (ops.adam_, adam),
        "sparse_adam_": (ops.sparse_adam_, [*sparse, *guard]),
        "run_ahead_": (ops.run_ahead_, [torch.zeros(5, dtype=torch.int64), [1, 1, 1], None]),  # refused: not on a GPU
        "step_now_": (ops.step_now_, _step_now()),
        "catch_up_": (
            ops.catch_up_,
            [*(rand(3, 4) for _ in range(3)), integers([0, 0, 0]), [0.1], [1.0], 0.9, 0.999, 1e-8],
        ),
        "in_host_memory": (ops.in_host_memory, [rand(3, 4)]),
        "is_in_host_memory": (ops.is_in_host_memory, [rand(3, 4)]),
        "observe_": (ops.observe_, [*statistics, single(3, 3)]),
        "split_positions": (
            ops.split_positions,
            [single(3, 3), single(3, 3), single(3, 4), torch.arange(3, device=device), 1, 2, 600, 0],
        ),
        "add_noise_": (
            ops.add_noise_,
            [*(single(3, width) for width in (3, 3, 4, 1)), 1.0, 100.0, 0.005, 1, 4, 600, None],
        ),
        "penalise_": (ops.penalise_, [*(rand(3, width) for width in (1, 3, 1, 3)), 0.01, 0.02]),
        "l1_ssim": (ssim.l1_ssim, [one, two, True, True]),
        "l1_ssim_vjp": (ssim.l1_ssim_vjp, [one, two, kept, gradient, gradient]),
        "photometric": (ssim.photometric, [one, two, 0.2, True, True]),
        "photometric_vjp": (ssim.photometric_vjp, [one, two, kept, 0.2, gradient, True]),
        "photometric_band": (ssim.photometric_band, [one, two, 0, one.shape[-2], True]),
        "photometric_of_sums": (ssim.photometric_of_sums, [one, ssim.photometric_band(one, two, 0, 0, True)[0], 0.2]),
        "photometric_band_vjp": (ssim.photometric_band_vjp, [one, two, kept, 0.2, gradient, 0, one.shape[-2]]),
        "composite": (ssim.composite, [integers([[[9] * 6] * 5] * 4).to(torch.uint8), single(3)]),
        "mean_distance2": (knn.mean_distance2, [rand(9, 3)]),
    }


def _step(raw: dict[str, Tensor]) -> list:
    """The arguments of `rasterize_vjp_step_` and `rows_vjp_step_` from `radii` to the statistics."""
    count = len(raw["means"])
    averages = [[torch.rand_like(value) for value in raw.values()] for _ in range(2)]
    counters = [torch.tensor(float(place)) for place in range(6)]
    device, observed = raw["means"].device, raw["means"].dtype == torch.float32
    statistics = [
        torch.rand(shape, device=device) if observed else None for shape in ((count,), (count, 1), (count, 1))
    ]
    adam = [*averages, counters, [0.1] * 6, 0.9, 0.99, 1e-8, [-1, -1, -1, -1, -1, 9]]
    return [torch.ones(count, dtype=torch.int32, device=device), list(range(6)), *adam, False, *statistics]


def _step_now() -> list:
    """The arguments of `step_now_`."""
    counters = [torch.tensor(float(place)) for place in range(6)]
    return [torch.zeros(22, dtype=torch.int64), list(range(6)), counters, [0.1] * 6, 0.9, 0.99, 1e-8, False, 7]


def outcomes() -> Iterator[tuple[str, str, str]]:
    """Make all changed calls; give the operator's name, what was changed, and the error's type or `returned`."""
    for name, (operator, arguments) in sound_calls().items():
        for words, changed in changed_tensors(arguments):
            try:
                operator(*changed)
                outcome = "returned"
            except Exception as error:  # of any type: the test judges
                outcome = type(error).__name__
            yield name, words, outcome


def changed_tensors(arguments: list) -> Iterator[tuple[str, list]]:
    """The arguments with one tensor replaced, each time, and words for what it was replaced by."""
    for place, value in enumerate(arguments):
        if torch.is_tensor(value):
            for words, other in _others(value):
                yield f"argument {place} {words}", [*arguments[:place], other, *arguments[place + 1 :]]
        elif isinstance(value, list) and value and torch.is_tensor(value[0]):
            for words, other in _others(value[-1]):
                inner = [*value[:-1], other]
                yield f"argument {place}[-1] {words}", [*arguments[:place], inner, *arguments[place + 1 :]]
            yield f"argument {place} shorter", [*arguments[:place], value[:-1], *arguments[place + 1 :]]


def _others(value: Tensor) -> Iterator[tuple[str, Any]]:
    yield "is None", None
    yield "is a number", 1.0
    for dtype in (torch.float16, torch.float64, torch.int64, torch.int32, torch.bool, torch.complex64):
        if dtype != value.dtype:
            yield f"is {dtype}", value.to(dtype)
    yield "has one more axis", value.unsqueeze(0)
    yield "has all values in a row", value.reshape(-1)
    yield "is a scalar", value.new_zeros(())
    yield "is empty", value.new_empty(0)
    if value.dim():
        yield "has no rows", value[:0]
        yield "has one row more", torch.cat([value, value[:1]])
        yield "has one row less", value[:-1]
        yield "has no columns", value[..., :0]
    if value.dim() > 1:
        yield "has one column more", torch.cat([value, value[..., :1]], dim=-1)
        yield "is transposed", value.transpose(0, -1)
    yield "is on no device", value.to("meta")
    yield "is sparse", value.to_sparse()
