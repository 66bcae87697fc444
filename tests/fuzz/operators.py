"""Calls of every operator of the three extensions, and changes of one tensor that must end in an error."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import diff_gaussian_rasterization.gsplat  # noqa: F401  (registers the fakes of `describe` and `pinhole`)
import torch
from diff_gaussian_rasterization.scene import Drawing
from fused_ssim.backend import OPERATORS as ssim
from rasterizer_tools import few, ops, scene_arguments
from simple_knn.backend import OPERATORS as knn
from torch import Tensor

from tests.workloads.splat_scenes import move_camera, settings

Call = tuple[Any, list]  # operator, arguments


def sound_calls(device: str = "cpu", dtype: torch.dtype = torch.float32) -> dict[str, Call]:
    """One call of each operator, by name. Operators that know no float64 get float32."""
    raw, size = few(dtype=dtype)
    raw, camera = {name: t.to(device) for name, t in raw.items()}, move_camera(settings(**size), device)
    rand, single = partial(torch.rand, device=device, dtype=dtype), partial(torch.rand, device=device)
    integers = partial(torch.tensor, device=device, dtype=torch.int32)
    height, width, background = camera.image_height, camera.image_width, camera.bg.to(dtype)
    scene = scene_arguments(raw, camera)
    splats, depths, rects, counts, radii = ops.project(*scene)
    instances, ranges, *slots = ops.bin(splats, depths, rects, counts, height, width, True)
    *planes, last, layers = ops.blend(splats, instances, ranges, background, height, width, True, True)
    if not len(layers):
        layers = rand(5 * 256)  # as a GPU makes them of few instances
    drawn = Drawing(*planes, radii, splats, counts, instances, ranges, *slots, last, layers)
    state, planes = list(drawn.kept(background)), [*map(torch.ones_like, planes)]
    rows = ops.blend_rows(state, *planes)
    values, behind, picture = rand(len(splats), 5), rand(5), rand(5, height, width)
    shown = [*state[:8], behind, state[9]]
    reach = [rects, counts, integers([[0, 2], [2, 5]])]
    numbered = torch.cat([ops.list_records(*reach)[0], integers([[1], [1], [2]])], 1)
    moments = ops.channel_moments(shown, values, picture, None, 0.99, True, False, False)[0]
    shaped = torch.where(counts[:, None] > 0, splats, -torch.inf)
    wanted = [True, True, True, True, True, False, False, True, True]
    source = [splats, counts, *rows]
    lists = [[rand(3, 3), rand(2, 5)] for _ in range(4)]
    guard = [rand(()), torch.zeros(1, dtype=torch.int64, device=device), 3]
    adam = [*lists, [torch.tensor(1.0), torch.tensor(7.0)], [0.1, 0.2], 0.9, 0.99, 1e-8, [2, -1], None, *guard]
    seen = torch.tensor([True, False, True], device=device)
    sparse = [*([rand(3, 3)] for _ in range(4)), [], [0.1], 0.9, 0.99, 1e-8, [-1], seen]
    statistics = [single(3), single(3, 1), single(3, 1), integers([0, 3, 5])]
    one, two, gradient = rand(3, 20, 20), rand(3, 20, 20), torch.ones((), dtype=dtype, device=device)
    kept = ssim.l1_ssim(one, two, False, True)[2]
    gaussians = [torch.empty(0) if t is None else t for t in scene.gaussians]
    in_lists = [gaussians, *([*entries] for entries in scene.lists[1:])]
    step = _step(raw, guard)
    return {
        "project": (ops.project, [*scene]),
        "project_binned": (ops.project_binned, [*scene, True]),
        "bin": (ops.bin, [splats, depths, rects, counts, height, width, True]),
        "blend": (ops.blend, [splats, instances, ranges, background, height, width, True, True]),
        "list_records": (ops.list_records, reach),
        "list_records with counts": (ops.list_records, [*reach, numbered, splats, depths, int(numbered[-1].sum())]),
        "sum_runs": (ops.sum_runs, [*rows, rows[1].clamp_max(1), int(rows[1].count_nonzero()), integers([1, 2, 0])]),
        "blend_channels": (ops.blend_channels, [splats, values, instances, ranges, behind, height, width, 0.99]),
        "blend_channels last": (
            ops.blend_channels,
            [splats, values, instances, ranges, behind, height, width, 0.99, True],
        ),
        "channel_moments": (ops.channel_moments, [shown, values, picture, planes[1], 0.99, True, True, True]),
        "describe": (ops.describe, [shaped, depths, counts, height, width]),
        "describe packed": (ops.describe, [shaped, depths, counts, height, width, True]),
        "describe_vjp": (ops.describe_vjp, [splats, counts, moments]),
        "pinhole": (ops.pinhole, [torch.eye(4, device=device, dtype=dtype), rand(3, 3), height, width]),
        "blend_rows": (ops.blend_rows, [state, *planes, True]),
        "rasterize": (ops.rasterize, [torch.zeros_like(raw["means"]), *scene, background, True, True]),
        "rasterize_vjp": (ops.rasterize_vjp, [*scene, wanted, state, *planes]),
        "rasterize_vjp of rows": (ops.rasterize_vjp, [*scene, wanted, source]),
        "rasterize_vjp of moments": (ops.rasterize_vjp, [*scene, wanted, [splats, counts, moments]]),
        "camera_vjp": (ops.camera_vjp, [*scene, source]),
        "sum_blocks": (ops.sum_blocks, [torch.rand(3, 5, device=device, dtype=torch.float64)]),
        "apply_gradients_": (ops.apply_gradients_, [*in_lists, state, planes, *step]),
        "apply_gradients_ of rows": (ops.apply_gradients_, [*in_lists, source, [], *step]),
        "wake_": (ops.wake_, _wake(in_lists, step)),
        "decisive": (ops.decisive, [splats, instances, ranges, last]),
        "adam_": (ops.adam_, adam),
        "adam_ of visible rows": (ops.adam_, [*sparse, *guard]),
        "run_ahead_": (ops.run_ahead_, [torch.zeros(5, dtype=torch.int64), [1, 1, 1], None]),  # refused: not on a GPU
        "step_now_": (ops.step_now_, _step_now()),
        "spilled": (ops.spilled, [rand(3, 4), 5, 0]),
        "spilled_bytes": (ops.spilled_bytes, [rand(3, 4)]),
        "observe_": (ops.observe_, [*statistics, single(3, 3)]),
        "displace_": (
            ops.displace_,
            [*(single(3, width) for width in (3, 3, 4, 1)), None, [1.0, 100.0, 0.005], 1, 4, 600, 0, None],
        ),
        "displace_ to children": (
            ops.displace_,
            [single(3, 3), single(3, 3), single(3, 4), None, torch.arange(3, device=device), [], 1, 2, 600, 0],
        ),
        "exp": (ops.exp, [rand(5).double()]),
        "log": (ops.log, [rand(5).double()]),
        "random_words": (ops.random_words, [torch.arange(3, device=device), 1, 2, 600, 0]),
        "penalise_": (ops.penalise_, [*(rand(3, width) for width in (1, 3, 1, 3)), 0.01, 0.02]),
        "l1_ssim": (ssim.l1_ssim, [one, two, True, True]),
        "l1_ssim_vjp": (ssim.l1_ssim_vjp, [one, two, kept, gradient, gradient]),
        "photometric": (ssim.photometric, [one, two, 0.2, True, True]),
        "photometric_vjp": (ssim.photometric_vjp, [one, two, kept, 0.2, gradient, True]),
        "photometric_band": (ssim.photometric_band, [one, two, 0, one.shape[-2], True]),
        "photometric_of_sums": (ssim.photometric_of_sums, [one, ssim.photometric_band(one, two, 0, 0, True)[0], 0.2]),
        "composite": (ssim.composite, [integers([[[9] * 6] * 5] * 4).to(torch.uint8), single(3)]),
        "mean_distance2": (knn.mean_distance2, [rand(9, 3)]),
    }


def _step(raw: dict[str, Tensor], guard: list) -> list:
    """The arguments of `apply_gradients_` behind `planes`."""
    count = len(raw["means"])
    averages = [torch.rand_like(value) for _ in range(2) for value in raw.values()]
    counters = [torch.tensor(float(place)) for place in range(6)]
    device, observed = raw["means"].device, raw["means"].dtype == torch.float32
    statistics = [torch.rand(shape, device=device) for shape in ((count,), (count, 1), (count, 1)) if observed]
    radii, columns = torch.ones(count, dtype=torch.int32, device=device), [-1, -1, -1, -1, -1, 9]
    constants = [0.9, 0.99, 1e-8, 0.0, 0.0]
    *guard, iteration = guard
    lists = radii, averages, counters, statistics, guard, list(range(6)), [0.1] * 6, constants, columns
    return [*lists, False, iteration]


def _wake(lists: list, step: list) -> list:
    """The arguments of `wake_`. lists, step: of `apply_gradients_`."""
    gaussians, camera, lens, options = lists
    blocks = torch.zeros(-(-len(gaussians[0]) // 128), dtype=torch.int32, device=gaussians[0].device)
    sleep = [blocks.to(torch.uint8), blocks, gaussians[0].new_zeros(128, 8)]
    _, averages, counters, _, *others = step
    return [gaussians, camera, lens, [*options[:4], True], sleep, False, averages, counters, *others[:5], others[6]]


def _step_now() -> list:
    """The arguments of `step_now_`."""
    counters = [torch.tensor(float(place)) for place in range(6)]
    return [torch.zeros(23, dtype=torch.int64), list(range(6)), counters, [0.1] * 6, 0.9, 0.99, 1e-8, False, 7]


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
            for inner in [k for k, one in enumerate(value) if torch.is_tensor(one) and one.shape != (0,)]:
                for words, other in _others(value[inner]):
                    changed = [*value[:inner], other, *value[inner + 1 :]]
                    yield f"argument {place}[{inner}] {words}", [*arguments[:place], changed, *arguments[place + 1 :]]
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
