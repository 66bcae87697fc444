"""Fake kernels: shapes and dtypes of the operators' results, for torch.compile and opcheck of torch's library."""

from collections.abc import Callable

import torch
from torch import Tensor, library

from diff_gaussian_rasterization.scene import GRADIENTS

# A Gaussian's values in each input; a row of sh_rest depends on the number of bands.
_ROWS = {"means": (3,), "means2d": (3,), "opacities": (1,), "scales": (3,), "rotations": (4,), "cov3d": (6,)}
_ROWS |= {"colors": (3,), "sh_dc": (1, 3)}
# These seven are constants of csrc; tests/test_rasterizer_ops.py holds them to it.
TILE = 16  # pixels
SPLAT_VALUES = 10  # of a row of `splats`
MOMENT_VALUES = 10  # of a row of `moments`, and of `rows`
RAY_VALUES = 4  # of a row of each besides, of Gaussians on rays
LENS_RAY_VALUES = 10  # of a row of `splats` besides, on those of a lens
ABSOLUTE_VALUES = 2  # of a row of `rows` besides, for absolute gradients
SLEEP_BLOCK = 128  # Gaussians that sleep together, and whose gradients of a camera are summed together
CAMERA_NUMBERS = 25, 34  # of a pinhole, and of a camera with a lens
RECORD_BLOCK = 256  # splats whose records are counted together


def fake(name: str) -> Callable:
    """Makes the decorator that registers the fake kernel of an operator."""
    return library.register_fake(f"diff_gaussian_rasterization::{name}")


def _make_lists(like: Tensor, count: int, height: int, width: int, train: bool) -> tuple[Tensor, ...]:
    """Return empty lists as the operator `bin` returns them: instances, ranges, splat_slots and slots.

    like: tensor that gives the device.
    count: number of Gaussians.
    train: true if a backward follows, which needs slots.
    """
    instances = library.get_ctx().new_dynamic_size()
    slots = library.get_ctx().new_dynamic_size() if train else 0
    tiles = -(-height // TILE) * -(-width // TILE)
    return (
        like.new_empty((instances,), dtype=torch.int32),
        like.new_empty((tiles + 1,), dtype=torch.int64),
        like.new_empty((count + 1 if train else 0, 2), dtype=torch.int64),
        like.new_empty((slots, 0), dtype=torch.int32),
    )


def _make_planes(like: Tensor, height: int, width: int, inverse_depth: bool, train: bool) -> tuple[Tensor, ...]:
    """Return empty planes as the operator `blend` returns them: color, transmittance, inverse_depth, last and layers.

    like: tensor that gives dtype and device.
    inverse_depth: true if it is wanted.
    train: true if a backward follows, which needs last and layers.
    """
    return (
        like.new_empty((3, height, width)),
        like.new_empty((1, height, width)),
        like.new_empty((1 if inverse_depth else 0, height, width)),
        like.new_empty((height if train else 0, width), dtype=torch.int32),
        like.new_empty((library.get_ctx().new_dynamic_size() if like.is_cuda and train else 0,)),
    )


def _make_splats(means: Tensor, lens: tuple[float, ...], options: tuple[int, ...]) -> Tensor:
    rays = any(options[5:])
    values = SPLAT_VALUES + RAY_VALUES * rays + LENS_RAY_VALUES * (rays and len(lens) > 5)
    return means.new_empty((means.shape[0], values))


@fake("project")
def _(means, *arguments):
    count = means.shape[0]
    ints = [means.new_empty(shape, dtype=torch.int32) for shape in ((count, 4), (count,), (count,))]
    return _make_splats(means, *arguments[10:12]), means.new_empty((count,)), *ints


@fake("project_binned")
def _(means, *arguments):
    count, (height, width, *_), train = means.shape[0], arguments[11], arguments[12]
    ints = (means.new_empty((count,), dtype=torch.int32) for _ in range(2))
    lists = _make_lists(means, count, height, width, train)
    return _make_splats(means, *arguments[10:12]), means.new_empty((count,)), *ints, *lists


@fake("bin")
def _(splats, depths, rects, tile_counts, height, width, train):
    return _make_lists(splats, splats.shape[0], height, width, train)


@fake("blend")
def _(splats, instances, ranges, background, height, width, inverse_depth, train):
    return _make_planes(splats, height, width, inverse_depth, train)


@fake("blend_rows")
def _(source, *arguments):
    """Return empty gradient rows (R, values), for any R, and their counts (N,) int32."""
    absolute = len(arguments) == 4 and arguments[-1]  # the dispatcher leaves a default out
    splats = source[0]
    values = splats.shape[1] - SPLAT_VALUES + MOMENT_VALUES + absolute * ABSOLUTE_VALUES
    rows = splats.new_empty((library.get_ctx().new_dynamic_size(), values))
    return rows, splats.new_empty((splats.shape[0],), dtype=torch.int32)


@fake("blend_channels")
def _(splats, channels, instances, ranges, background, height, width, cap, channels_last=False):
    image = (1, height, width, channels.shape[1]) if channels_last else (channels.shape[1], height, width)
    last, alpha = splats.new_empty((height, width), dtype=torch.int32), (1, height, width, 1) if channels_last else (0,)
    return splats.new_empty(image), splats.new_empty((1, height, width)), last, splats.new_empty(alpha)


@fake("channel_moments")
def _(source, channels, grad_color, grad_transmittance, cap, stops, absolute, wanted, channels_last=False):
    """Return empty moments, lengths of absolute gradients (N,), and gradients of channels (N, C)."""
    splats = source[0]
    count = splats.shape[0]
    lengths = splats.new_empty((count if absolute else 0,))
    return torch.empty_like(splats), lengths, splats.new_empty((count if wanted else 0, channels.shape[1]))


@fake("rasterize_vjp")
def _(means, opacities, *arguments):
    """Return empty gradients, one for each of GRADIENTS; those that are not wanted have no rows."""
    sh_rest, wanted = arguments[5], arguments[11]
    rows = _ROWS | {"sh_rest": (0 if sh_rest is None else sh_rest.shape[1], 3)}
    rows["opacities"] = opacities.shape[1:] if wanted[2] else (1,)
    counts = [means.shape[0] if is_wanted else 0 for is_wanted in wanted]
    return tuple(means.new_empty((count, *rows[name])) for name, count in zip(GRADIENTS, counts, strict=True))


@fake("camera_vjp")
def _(means, *arguments):
    lens = arguments[10]
    blocks = -(-means.shape[0] // SLEEP_BLOCK)
    return means.new_empty((blocks, CAMERA_NUMBERS[len(lens) > 5]), dtype=torch.float64)


@fake("sum_blocks")
def _(sums):
    return sums.new_empty(sums.shape[1:])


@fake("rasterize")
def _(means2d, means, *arguments):
    """Return empty planes, radii, splats, tile_counts and lists, in the order of `Drawing`."""
    options, _, inverse_depth, train = arguments[11:15]  # what follows is left out where it has its default
    count, (height, width, *_) = means.shape[0], options
    color, transmittance, depth, last, layers = _make_planes(means, height, width, inverse_depth, train)
    radii, tile_counts = (means.new_empty((count,), dtype=torch.int32) for _ in range(2))
    projected = radii, _make_splats(means, arguments[10], options), tile_counts
    lists = _make_lists(means, count, height, width, train)
    return color, transmittance, depth, *projected, *lists, last, layers


@fake("decisive")
def _(splats, *_):
    return splats.new_empty((splats.shape[0],), dtype=torch.bool)


@fake("list_records")
def _(rects, tile_counts, limits, counts=None, splats=None, depths=None, room=0):
    """Return empty counts of records by block; given the counts, empty lists with `room` records in their place."""
    if counts is None:
        counts = rects.new_empty((limits.shape[1] + 1, -(-rects.shape[0] // RECORD_BLOCK)))
        return counts, *(rects.new_empty((0,)) for _ in range(6))
    lists = rects.new_empty((0,)), rects.new_empty((room,), dtype=torch.int64), rects.new_empty((room,))
    return *lists, *(t.new_empty((room, *t.shape[1:])) for t in (splats, depths, rects, tile_counts))


@fake("sum_runs")
def _(rows, counts, kept, room, places=None):
    return rows.new_empty((room, rows.shape[1]))


@fake("adam_")
@fake("apply_gradients_")
@fake("displace_")
@fake("observe_")
@fake("penalise_")
@fake("step_now_")
def _(*_args, **_keywords):
    return None
