"""A mesh of a model's surfaces: depths of the training views, fused to signed distances, and their zero level.

The zero level is that of marching cubes (Lewiner et al. 2003), where all corners of a cube are known: what no view
shows stays open. Connected parts much smaller than the largest one are left out, which are mostly of floaters.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gaussian_renderer.free_view import free_view
from gaussian_renderer.median_depth import surface_of
from scene.cameras import Camera, MiniCam
from scene.gaussian_model import GaussianModel
from scene.splats.splats import Splats
from scene.with_splats import model_of
from splatting.camera_paths.poses import keyframe, opening, poses_of
from splatting.exports.tsdf import BYTES, SIDE, TooManyBlocks, Volume
from splatting.host.progress import Bar
from utils.system_utils import UserError

MOST_VOXELS = 100_000_000
_PIXELS = 2.0  # default size of a voxel, in pixels at the median depth
_FAR = 4.0  # median depths beyond which surfaces are left out
_TRIED = 16  # views that the median depth is of
_COARSER = 1.5
_SMALL = 0.001
_CHUNK = 16  # blocks of a cube that marching cubes takes at once
_NOT_ZERO = 1e-3  # a distance of zero would put several edges' points at one corner


@dataclass(frozen=True)
class Mesh:
    """vertices (V, 3) float32 in the frame of the splats; faces (F, 3) int32; colors (V, 3) uint8.

    Faces are counter-clockwise where they are seen from.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray


def mesh_of(
    splats: Splats, cameras: Sequence[Camera], pipe: argparse.Namespace, voxel: float | None = None
) -> tuple[Mesh, str]:
    """The large parts of the mesh of splats, and a part of a sentence about it. Arguments as for `volume_of`."""
    volume = volume_of(splats, cameras, pipe, voxel)
    mesh = large_parts(zero_level(volume))
    counts = f"{len(mesh.vertices):,} vertices, {len(mesh.faces):,} triangles"
    return mesh, f"{counts}, {len(volume.keys) * SIDE**3 * BYTES / 1e9:.2f} GB of voxels of {volume.voxel:.3g}"


def volume_of(
    splats: Splats, cameras: Sequence[Camera], pipe: argparse.Namespace, voxel: float | None = None
) -> Volume:
    """Distances from the surfaces that cameras see.

    voxel: its size in the world's unit. None: two pixels at the median depth, or larger where the voxels would be more
    than MOST_VOXELS. UserError if a given size makes more or is far below a pixel, and if no camera sees a surface.
    """
    gaussians = model_of(splats)
    pipe = argparse.Namespace(**(vars(pipe) | {"antialiasing": splats.antialiasing}))
    views = pinholes(cameras)
    if not views:
        raise UserError("a mesh needs training cameras, from which it sees the surfaces; the scene has none")
    tried = views[:: -(-len(views) // _TRIED)]
    spans = [_spans(view, surface_of(view, gaussians, pipe).depth) for view in tried]
    if not any(spans):
        raise UserError("a mesh needs surfaces, and no training view shows anything opaque; train for longer")
    depth, pixel = np.median([span for span in spans if span], axis=0).tolist()
    small = voxel is not None and SIDE * voxel < pixel  # blocks around the surface in neighbouring pixels do not touch
    size = _PIXELS * pixel if voxel is None or small else voxel
    volume = _empty_volume(gaussians, views, pipe, size, _FAR * depth, coarser=voxel is None or small)
    if small:
        usual = f"which is {pixel:.2g} at the usual depth"
        raise UserError(f"--voxel {voxel:g} is far below a pixel, {usual}; give {volume.voxel:.2g} or more")
    for view in Bar(views, desc="Fusing depths", unit="view"):
        surface = surface_of(view, gaussians, pipe)
        volume.add_view(view, _within(surface.depth, _FAR * depth), surface.color)
    return volume


def pinholes(cameras: Sequence[Camera]) -> list[Camera | MiniCam]:
    """The views, and in the places of those with lenses views without, as wide as these are high, or 60 degrees."""
    views = []
    for camera, poses in ((camera, poses_of([camera])) for camera in cameras):
        if getattr(camera, "lens", None) is not None:
            pose = keyframe(0.0, poses.positions[0], poses.turns[0], 0.0)
            size = camera.image_width, camera.image_height
            camera = free_view(*size, opening(camera), pose.position, pose.wxyz, camera.device)
        views.append(camera)
    return views


def _spans(view: Camera | MiniCam, depth: Tensor) -> tuple[float, float] | None:
    """The median depth of a view, and the height of a pixel there; None of an empty one."""
    known = depth[depth > 0]
    if not len(known):
        return None
    median = float(known.median())
    return median, median * 2 * float(np.tan(view.FoVy / 2)) / view.image_height


def _within(depth: Tensor, far: float) -> Tensor:
    return torch.where(depth < far, depth, 0)


def _empty_volume(
    gaussians: GaussianModel,
    views: Sequence[Camera | MiniCam],
    pipe: argparse.Namespace,
    voxel: float,
    far: float,
    coarser: bool,
) -> Volume:
    """The blocks of all surfaces nearer than `far`, empty. coarser: of a larger voxel, where they would be too many."""
    given = voxel
    while True:
        volume = Volume(voxel, gaussians.get_xyz.device)
        try:
            for view in Bar(views, desc="Finding surfaces", unit="view"):
                depth = _within(surface_of(view, gaussians, pipe).depth, far)
                volume.add_blocks(view, depth, MOST_VOXELS // SIDE**3)
        except TooManyBlocks:
            voxel = float(f"{_COARSER * voxel:.2g}")  # as a user would type it
            continue
        if voxel > given and not coarser:
            raise UserError(
                f"--voxel {given:g} makes more than {MOST_VOXELS / 1e6:.0f} million voxels of "
                f"{BYTES * MOST_VOXELS / 1e9:.0f} GB; give {voxel:g} or more"
            )
        volume.start()
        return volume


def zero_level(volume: Volume) -> Mesh:
    """All surfaces of a volume. UserError if there are none."""
    from skimage.measure import marching_cubes

    parts, faces, colors, keys, count = [], [], [], [], 0
    for origin, distances, tints, known in volume.chunks(_CHUNK):
        cubes = np.zeros_like(known)  # at a cube's last corner
        inner = known[:-1] & known[1:]
        inner = inner[:, :-1] & inner[:, 1:]
        cubes[1:, 1:, 1:] = inner[:, :, :-1] & inner[:, :, 1:]
        values = np.where(np.abs(distances) < _NOT_ZERO, np.float32(_NOT_ZERO), distances)
        if not cubes.any() or values[known].min() > 0 or values[known].max() < 0:
            continue
        try:
            places, triangles, _, _ = marching_cubes(values, 0.0, mask=cubes)
        except RuntimeError:  # no surface
            continue
        keys.append(_edges(places, origin))
        faces.append(triangles.astype(np.int64) + count)
        colors.append(_interpolated(tints, places))
        parts.append((places + origin.astype(np.float64)) * volume.voxel)
        count += len(places)
    if not count:
        raise UserError("the training views show no surface; give a smaller --voxel, or train for longer")
    # Cubes beside each other have the same points on their common side.
    _, first, same = np.unique(np.concatenate(keys), axis=0, return_index=True, return_inverse=True)
    tints = np.floor(255 * np.concatenate(colors)[first] + 0.5).astype(np.uint8)
    vertices = np.concatenate(parts)[first].astype(np.float32)
    return Mesh(vertices, same.reshape(-1)[np.concatenate(faces)].astype(np.int32), tints)


def _edges(places: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(V, 4) int64: the edge of the grid on which each point lies, and its axis; of one within a cube, axis 3."""
    nearest = np.round(places)
    off = np.abs(places - nearest)
    axis = np.where(np.sort(off, axis=1)[:, 1] < _NOT_ZERO / 10, off.argmax(axis=1), 3)
    along = (np.arange(3) == axis[:, None]) | (axis == 3)[:, None]
    lower = np.where(along, np.floor(places), nearest).astype(np.int64)
    return np.column_stack([lower + origin, axis])


def _interpolated(colors: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Colours (V, 3) between the ends of each point's edge."""
    low, high = np.floor(places).astype(int), np.ceil(places).astype(int)
    share = (places - low).max(axis=1, keepdims=True)
    return (1 - share) * colors[tuple(low.T)] + share * colors[tuple(high.T)]


def large_parts(mesh: Mesh) -> Mesh:
    """The connected parts of which each has at least a share _SMALL of the triangles of the largest one.

    The largest one alone would often lack the subject: photos hardly show where it stands on the floor.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count, (a, b, c) = len(mesh.vertices), mesh.faces.T
    edges = np.concatenate([a, b]), np.concatenate([b, c])
    _, part = connected_components(coo_matrix((np.ones(len(edges[0]), bool), edges), (count, count)), directed=False)
    sizes = np.bincount(part[a])
    faces = mesh.faces[sizes[part[a]] >= _SMALL * sizes.max()]
    used, faces = np.unique(faces, return_inverse=True)
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32), mesh.colors[used])
