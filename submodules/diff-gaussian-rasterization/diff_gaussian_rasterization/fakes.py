"""Fake kernels: shapes and dtypes of the operators' results, for torch.compile and opcheck of torch's library."""

import torch
from torch import Tensor, library

from diff_gaussian_rasterization.schema import GRADIENTS, SCENE

# A Gaussian's values in each input; a row of sh_rest depends on the number of bands.
_ROWS = {"means": (3,), "means2d": (3,), "opacities": (1,), "scales": (3,), "rotations": (4,), "cov3d": (6,)}
_ROWS |= {"colors": (3,), "sh_dc": (1, 3)}
# These five are constants of csrc; tests/test_rasterizer_ops.py holds them to it.
TILE = 16  # pixels
SPLAT_VALUES = 10  # of a row of `splats`
MOMENT_VALUES = 10  # of a row of `moments`, and of `rows`
ABSOLUTE_VALUES = 2  # of a row of `rows` besides, for absolute gradients
RECORD_BLOCK = 256  # splats whose records are counted together


def _fake(name: str):
    return library.register_fake(f"diff_gaussian_rasterization::{name}")


def _scene(arguments: tuple) -> dict:
    return dict(zip(SCENE, arguments[: len(SCENE)], strict=True))


def _gradients(scene: dict, wanted: list[bool]) -> tuple[Tensor, ...]:
    means, sh_rest = scene["means"], scene["sh_rest"]
    rows = _ROWS | {"sh_rest": (0 if sh_rest is None else sh_rest.shape[1], 3)}
    counts = [means.shape[0] if is_wanted else 0 for is_wanted in wanted]
    return tuple(means.new_empty((count, *rows[name])) for name, count in zip(GRADIENTS, counts, strict=True))


def _binned(like: Tensor, count: int, height: int, width: int, train: bool) -> tuple[Tensor, ...]:
    instances = library.get_ctx().new_dynamic_size()
    slots = library.get_ctx().new_dynamic_size() if train else 0
    tiles = -(-height // TILE) * -(-width // TILE)
    return (
        like.new_empty((instances,), dtype=torch.int32),
        like.new_empty((tiles + 1,), dtype=torch.int64),
        like.new_empty((count + 1 if train else 0, 2), dtype=torch.int64),
        like.new_empty((slots, 0), dtype=torch.int32),
    )


def _blended(like: Tensor, height: int, width: int, inverse_depth: bool, train: bool) -> tuple[Tensor, ...]:
    return (
        like.new_empty((3, height, width)),
        like.new_empty((1, height, width)),
        like.new_empty((1 if inverse_depth else 0, height, width)),
        like.new_empty((height if train else 0, width), dtype=torch.int32),
        like.new_empty((library.get_ctx().new_dynamic_size() if like.is_cuda and train else 0,)),
    )


@_fake("project")
def _(means, *_):
    count = means.shape[0]
    ints = [means.new_empty(shape, dtype=torch.int32) for shape in ((count, 4), (count,), (count,))]
    return means.new_empty((count, SPLAT_VALUES)), means.new_empty((count,)), *ints


@_fake("bin")
def _(splats, depths, rects, tile_counts, height, width, train):
    return _binned(splats, splats.shape[0], height, width, train)


@_fake("blend")
def _(splats, instances, ranges, background, height, width, inverse_depth, train):
    return _blended(splats, height, width, inverse_depth, train)


@_fake("blend_vjp")
def _(splats, *_):
    return splats.new_empty((splats.shape[0], MOMENT_VALUES))


@_fake("blend_rows")
def _(splats, *others):
    *_, absolute = others if isinstance(others[-1], bool) else (False,)  # the dispatcher leaves a default out
    values = MOMENT_VALUES + (ABSOLUTE_VALUES if absolute else 0)
    rows = splats.new_empty((library.get_ctx().new_dynamic_size(), values))
    return rows, splats.new_empty((splats.shape[0],), dtype=torch.int32)


@_fake("project_vjp")
@_fake("rasterize_vjp")
@_fake("rows_vjp")
def _(*arguments):
    (wanted,) = [value for value in arguments if isinstance(value, list)]
    return _gradients(_scene(arguments), wanted)


@_fake("rasterize")
def _(means2d, *arguments):
    scene, (inverse_depth, train) = _scene(arguments), arguments[len(SCENE) + 1 :][:2]
    means, height, width = scene["means"], scene["height"], scene["width"]
    count = means.shape[0]
    color, transmittance, depth, last, layers = _blended(means, height, width, inverse_depth, train)
    radii, tile_counts = (means.new_empty((count,), dtype=torch.int32) for _ in range(2))
    projected = radii, means.new_empty((count, SPLAT_VALUES)), tile_counts
    lists = _binned(means, count, height, width, train)
    return color, transmittance, depth, *projected, *lists, last, layers


@_fake("mark_visible")
def _(means, view):
    return means.new_empty((means.shape[0],), dtype=torch.bool)


@_fake("decisive")
def _(splats, *_):
    return splats.new_empty((splats.shape[0],), dtype=torch.bool)


@_fake("split_positions")
def _(means, *_):
    return means.new_empty((means.shape[0], 3))


@_fake("unpack_splats")
def _(packed, like):
    count = packed.shape[0]
    floats = like.new_empty((count, SPLAT_VALUES)), like.new_empty((count,))
    return *floats, packed.new_empty((count, 4)), packed.new_empty((count,))


@_fake("count_records")
def _(rects, tile_counts, limits):
    return rects.new_empty((limits.shape[1] + 1, -(-rects.shape[0] // RECORD_BLOCK)))


@_fake("list_records")
def _(rects, tile_counts, limits, counts, room):
    return rects.new_empty((room,), dtype=torch.int64), rects.new_empty((room,))


@_fake("sum_runs")
def _(rows, counts, kept, room):
    return rows.new_empty((room, rows.shape[1]))


@_fake("sum_parts")
def _(counts, sizes):
    return counts.new_empty((len(sizes),), dtype=torch.int64)


@_fake("move_runs")
def _(rows, *_):
    return rows.new_empty(rows.shape)


@_fake("in_host_memory")
def _(values):
    return torch.empty_like(values)


@_fake("adam_")
@_fake("catch_up_")
@_fake("sparse_adam_")
@_fake("observe_")
@_fake("rasterize_vjp_step_")
@_fake("rows_vjp_step_")
@_fake("step_now_")
@_fake("add_noise_")
@_fake("penalise_")
@_fake("pack_splats_")
@_fake("rows_vjp_add_")
def _(*_args, **_keywords):
    return None
