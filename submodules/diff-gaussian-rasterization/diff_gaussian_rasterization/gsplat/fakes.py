"""Fake kernels of the operators of gsplat's function."""

import torch
from torch import library

from diff_gaussian_rasterization.fakes import fake


@fake("describe_vjp")
def _(splats, tile_counts, moments, rows=None):
    count = (splats if rows is None else rows).shape[0]
    return tuple(splats.new_empty((count, *row)) for row in ((2,), (3,), ()))


@fake("pinhole")
def _(pose, intrinsics, height, width):
    return pose.new_empty((4, 4)), pose.new_empty((4, 4)), pose.new_empty((3,))


@fake("describe")
def _(splats, depths, tile_counts, height, width, packed=False):
    """Return empty radii, means2d, depths, conics, opacities, tiles and rows; any number of rows if packed."""
    count = library.get_ctx().new_dynamic_size() if packed else splats.shape[0]
    floats = (splats.new_empty((count, *row)) for row in ((2,), (), (3,), ()))
    listed = (count if packed else 0,)
    radii, tiles = (splats.new_empty(shape, dtype=torch.int32) for shape in ((count, 2), listed))
    return radii, *floats, tiles, splats.new_empty(listed, dtype=torch.int64)
