"""Solid surfaces, on which a page's guests walk and at which they stop: voxels, in the form that the viewer reads.

The form is an octree (Laine and Karras 2010), breadth first: an inner node has a mask of its children in bits 24 to 31
and the index of the first of them below, a leaf is SOLID or has the index of a mask of 4 x 4 x 4 voxels.
"""

import argparse
import json
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from applications.export.mesh import fuse_volume
from applications.export.surfaces import Surfaces
from applications.export.tsdf import TRUNCATION, Volume
from applications.export.upright import move_inputs, move_splats
from gaussian_renderer.camera_paths.poses import poses_of
from groundwork.files.similarity import Similarity
from scene.cameras import Camera
from scene.splats.splats import Splats, opacities
from utils.system_utils import UserError

if TYPE_CHECKING:
    from applications.export.formats import SceneInputs

EYES = 1.5  # metres above the floor, of the viewer's walkers
VOXEL = 0.05  # metres
LEAST = 5.0  # metres, of the sides of a place to walk in; the viewer asks it of all Gaussians, however far they are
LEAF = 4  # voxels of a leaf's edge
SOLID = 0xFF000000
_LOW = 0.02  # part of what is opaque that lies under the floor
_OPAQUE = 0.5
_CHUNK = 8  # blocks of a cube that is dense
_THICK = 2  # voxels of the floor where no photo shows it
_RAIL = 1.0  # metres, around that floor
_TURN = np.array([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])  # from y down to the viewer's axes


class Solid(NamedTuple):
    """The viewer's two files: the text of its .voxel.json, and the content of its .voxel.bin."""

    about: str
    content: bytes


def make_walkable(splats: Splats, around: "SceneInputs") -> tuple[Splats, "SceneInputs"]:
    """Move the splats, and the `SceneInputs` with them, upright and into metres, as the viewer's walkers are."""
    from applications.export.html import find_up, turn_upright

    if not around.upright:
        turn = turn_upright(find_up(poses_of(around.cameras)))
        upright = Similarity(turn, 1.0, np.zeros(3), splats.place, metric=around.metric)
        splats, around = _move_all(splats, around, upright)
    if not around.metric:
        scale = measure_metre(splats, around.cameras)
        print(f"--walk: photos are taken to be made {EYES} m above the floor, which makes a unit {scale:.3g} m")
        splats, around = _move_all(splats, around, Similarity(np.eye(3), scale, np.zeros(3), splats.place, metric=True))
    return splats, around


def _move_all(splats: Splats, around: "SceneInputs", similarity: Similarity) -> tuple[Splats, "SceneInputs"]:
    """Move the splats and the inputs of the export by a similarity."""
    return move_splats(splats, similarity), move_inputs(around, similarity)


def measure_metre(splats: Splats, cameras: Sequence[Camera]) -> float:
    """The scale that puts the median camera EYES above the lowest surfaces. Arguments have y down.

    UserError where the cameras are not above them.
    """
    heights = -splats.means[opacities(splats) > _OPAQUE, 1].astype(np.float64)
    eyes = -float(np.median(poses_of(cameras).positions[:, 1]))
    above = eyes - float(np.quantile(heights, _LOW)) if len(heights) else 0.0
    if above <= 0:
        raise UserError("--walk needs photos that look at a floor from above it; leave --walk out")
    return EYES / above


def make_solid(splats: Splats, cameras: Sequence[Camera], pipe: argparse.Namespace) -> Solid | None:
    """Make the voxels of the surfaces that cameras see, and a floor with rails under all of it. Metres, y down.

    A place that is narrower than LEAST has none: a line says so, and None is returned.
    """
    volume = _fuse_coarser(splats, cameras, pipe)
    voxels, surface = _find_solid_voxels(volume)
    level = int(np.quantile(voxels[surface, 1], 1 - _LOW))
    low, high = voxels.min(axis=0), voxels.max(axis=0)
    x, z = (np.arange(low[axis], high[axis] + 1) for axis in (0, 2))
    rail = np.arange(level - round(_RAIL / volume.voxel), level)
    floor = [x, level + np.arange(_THICK), z], [x[[0, -1]], rail, z], [x, rail, z[[0, -1]]]
    narrow = volume.voxel * min(len(x), len(z)) < LEAST
    across = " x ".join(f"{volume.voxel * len(side):.1f}" for side in (x, z))
    end = f", too small to walk in; guests can walk in {LEAST:g} x {LEAST:g} or more" * narrow
    print(f"--walk: the photos show {across} metres{end}")
    if narrow:
        return None
    added = [np.stack(np.meshgrid(*ranges, indexing="ij"), -1).reshape(-1, 3) for ranges in floor]
    return encode_octree(np.concatenate([voxels, *added]) @ _TURN.astype(np.int64), volume.voxel)


def _fuse_coarser(splats: Splats, cameras: Sequence[Camera], pipe: argparse.Namespace) -> Volume:
    """Make a volume with voxels of VOXEL, or of larger ones for photos that are too coarse or a scene too large."""
    surfaces = Surfaces(splats, cameras, pipe)
    for coarser in (1, 2, 4):
        try:
            return fuse_volume(surfaces, coarser * VOXEL)
        except UserError as error:
            last = error
    said = (
        "--walk needs a place that is some metres to some hundred metres wide; crop it by --crop, or leave --walk out"
    )
    raise UserError(said) from last


def _find_solid_voxels(volume: Volume) -> tuple[np.ndarray, np.ndarray]:
    """(V, 3) int64: the voxels close behind a surface; and (V,) bool: those of them next to it."""
    places, near = [], []
    for origin, distances, known, _ in volume.chunks(_CHUNK, confirmed=1):
        solid = known & (distances < 0)
        places.append(np.argwhere(solid) + origin)
        near.append(distances[solid] > -1 / TRUNCATION)
    if not sum(map(len, places)):
        raise UserError("--walk needs surfaces, and the training views show none; train for longer")
    return np.concatenate(places), np.concatenate(near)


def encode_octree(voxels: np.ndarray, size: float) -> Solid:
    """The files of solid voxels (V, 3) int64, of which (i, j, k) has its centre at `size` times (i, j, k)."""
    low = voxels.min(axis=0)
    blocks, within = np.divmod(voxels - low, LEAF)
    depth = max(1, math.ceil(math.log2(int(blocks.max()) + 1)))
    codes = _encode_morton(blocks, depth)
    leaves, block = np.unique(codes, return_inverse=True)
    bits = np.zeros((len(leaves), LEAF**3), bool)
    bits[block.reshape(-1), within @ np.array([1, LEAF, LEAF**2])] = True
    full = bits.all(axis=1)
    masks = np.packbits(bits[~full], axis=1, bitorder="little").view("<u4")
    levels = [np.where(full, SOLID, np.cumsum(~full) - 1).astype("<u4")]
    codes = leaves
    for _ in range(depth):
        parents, first = np.unique(codes >> 3, return_index=True)
        children = np.bitwise_or.reduceat(1 << (codes & 7), first)
        levels.append((children << 24 | first).astype("<u4"))
        codes = parents
    levels.reverse()
    starts = np.cumsum([len(level) for level in levels])
    for level, start in zip(levels[:-1], starts, strict=False):
        level += np.uint32(start)
    nodes = np.concatenate(levels)
    if len(nodes) >= 1 << 24:
        raise UserError("--walk: the scene has too many surfaces; crop it by --crop")
    edge = (voxels.max(axis=0) - low) // LEAF * LEAF + LEAF
    corner = (low - 0.5) * size
    about = {
        "version": "1.1",
        "gridBounds": {"min": corner.tolist(), "max": (corner + edge * size).tolist()},
        "voxelResolution": size,
        "leafSize": LEAF,
        "treeDepth": depth,
        "nodeCount": len(nodes),
        "leafDataCount": masks.size,
    }
    return Solid(json.dumps(about), nodes.tobytes() + masks.tobytes())


def _encode_morton(blocks: np.ndarray, depth: int) -> np.ndarray:
    """(B,) int64: the bits of x, y and z by turns, x lowest."""
    codes = np.zeros(len(blocks), np.int64)
    for level in range(depth):
        codes |= ((blocks >> level & 1) << (3 * level + np.arange(3))).sum(axis=1)
    return codes
