"""A mesh of a model's surfaces: depths of the training views, fused to signed distances, and their zero level.

The zero level is that of marching cubes (Lewiner et al. 2003), where several views confirm all corners of a cube: what
they do not show stays open. It is cleaned (mesh_cleaning.py), and made of fewer triangles by quadric error (Garland and
Heckbert 1997).
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from applications.export.mesh_cleaning import area_vectors, keep_whole_parts, smooth_rims
from applications.export.mesh_colors import color_points
from applications.export.surfaces import Surfaces
from applications.export.texture import make_texture
from applications.export.tsdf import BYTES, SIDE, TooManyBlocks, Volume
from scene.cameras import Camera
from scene.splats.splats import Splats
from utils.system_utils import UserError

MOST_VOXELS = 100_000_000
CONFIRMED = 3  # views that a surface needs
TRIANGLES = 200_000  # of a mesh with a texture, unless the user wants another number
_PIXELS = 2.0  # default size of a voxel, in pixels at the median depth
_COARSER = 1.5
_CHUNK = 16  # blocks of a cube that marching cubes takes at once
_NOT_ZERO = 1e-3  # a distance of zero would put several edges' points at one corner


@dataclass(frozen=True)
class Mesh:
    """vertices (V, 3) float32 in the frame of the splats; faces (F, 3) int32; normals (V, 3) float32, of unit length.

    Faces are counter-clockwise where they are seen from. It has colors (V, 3) uint8, or a texture (H, W, 3) uint8 and
    places in it, uv (V, 2) float32 from the image's upper left corner, 0 to 1.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    colors: np.ndarray | None = None
    uv: np.ndarray | None = None
    texture: np.ndarray | None = None


def measure_surfaces(
    splats: Splats, cameras: Sequence[Camera], pipe: argparse.Namespace, voxel: float | None = None
) -> tuple[Surfaces, Volume]:
    """Return the surfaces of splats that the cameras see, and the distances from these surfaces in voxels.

    voxel: side of a voxel in the unit of the model; None: about two pixels at the usual depth.
    UserError without cameras or surfaces, and for a voxel that is far below a pixel or makes too many.
    """
    surfaces = Surfaces(splats, cameras, pipe)
    return surfaces, fuse_volume(surfaces, voxel)


def make_mesh(
    surfaces: Surfaces, volume: Volume, triangles: int | None = None, with_texture: bool = False
) -> tuple[Mesh, str]:
    """Make the clean mesh of surfaces, and a part of a sentence about it. UserError where nothing is left.

    triangles: at most. None: TRIANGLES of a mesh with a texture, and all of one with colours.
    """
    vertices, every = keep_whole_parts(*extract_zero_level(volume, min(CONFIRMED, len(surfaces.views))))
    vertices, faces = reduce_triangles(
        smooth_rims(vertices, every), every, triangles or (TRIANGLES if with_texture else len(every))
    )
    normals = vertex_normals(vertices, faces)
    if with_texture:
        mesh = Mesh(*make_texture(vertices, faces, normals, surfaces, volume.voxel))
        look = f"a texture of {mesh.texture.shape[1]} x {mesh.texture.shape[0]} pixels, "
    else:
        colors = color_points(vertices, normals, surfaces, volume.voxel)
        mesh, look = Mesh(vertices, faces, normals, colors), ""
    counts = f"{len(vertices):,} vertices, {len(faces):,} of {len(every):,} triangles"
    return mesh, f"{counts}, {look}{len(volume.keys) * SIDE**3 * BYTES / 1e9:.2f} GB of voxels of {volume.voxel:.3g}"


def fuse_volume(surfaces: Surfaces, voxel: float | None = None) -> Volume:
    """Distances from surfaces.

    voxel: its size in the world's unit. None: two pixels at the median depth, or larger where the voxels would be more
    than MOST_VOXELS. UserError if a given size makes more or is far below a pixel.
    """
    pixel = surfaces.pixel
    small = voxel is not None and SIDE * voxel < pixel  # blocks around the surface in neighbouring pixels do not touch
    size = _PIXELS * pixel if voxel is None or small else voxel
    volume = _make_empty_volume(surfaces, size, coarser=voxel is None or small)
    if small:
        usual = f"which is {pixel:.2g} at the usual depth"
        raise UserError(f"--voxel {voxel:g} is far below a pixel, {usual}; give {volume.voxel:.2g} or more")
    for view, surface in surfaces.each("Fusing depths"):
        volume.add_view(view, surface.depth)
    return volume


def _make_empty_volume(surfaces: Surfaces, voxel: float, coarser: bool) -> Volume:
    """The blocks of all surfaces, empty. coarser: of a larger voxel, where they would be too many."""
    given = voxel
    while True:
        volume = Volume(voxel, surfaces.device)
        try:
            for view, surface in surfaces.each("Finding surfaces"):
                volume.add_blocks(view, surface.depth, MOST_VOXELS // SIDE**3)
        except TooManyBlocks:
            voxel = float(f"{_COARSER * voxel:.2g}")  # as a user would type it
            continue
        if voxel > given and not coarser:
            raise UserError(
                f"--voxel {given:g} makes more than {MOST_VOXELS / 1e6:.0f} million voxels of "
                f"{BYTES * MOST_VOXELS / 1e9:.1f} GB; give {voxel:g} or more"
            )
        volume.start()
        return volume


def extract_zero_level(volume: Volume, confirmed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices (V, 3) and faces (F, 3) of the surfaces that views see, and the weights (V,) of the vertices.

    confirmed: number of views that have to see a surface.
    A weight is that of the volume there, which counts pixels of the views. UserError if there are no surfaces.
    """
    from skimage.measure import marching_cubes

    parts, faces, keys, weights, count = [], [], [], [], 0
    for origin, distances, known, sums in volume.chunks(_CHUNK, confirmed):
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
        keys.append(_find_edges(places, origin))
        faces.append(triangles.astype(np.int64) + count)
        weights.append(sums[tuple(places.astype(int).T)])
        parts.append((places + origin.astype(np.float64)) * volume.voxel)
        count += len(places)
    if not count:
        raise UserError("the training views show no surface; give a smaller --voxel, or train for longer")
    # Cubes beside each other have the same points on their common side.
    _, first, same = np.unique(np.concatenate(keys), axis=0, return_index=True, return_inverse=True)
    vertices = np.concatenate(parts)[first].astype(np.float32)
    return vertices, same.reshape(-1)[np.concatenate(faces)].astype(np.int32), np.concatenate(weights)[first]


def _find_edges(places: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(V, 4) int64: the edge of the grid on which each point lies, and its axis; of one within a cube, axis 3."""
    nearest = np.round(places)
    off = np.abs(places - nearest)
    axis = np.where(np.sort(off, axis=1)[:, 1] < _NOT_ZERO / 10, off.argmax(axis=1), 3)
    along = (np.arange(3) == axis[:, None]) | (axis == 3)[:, None]
    lower = np.where(along, np.floor(places), nearest).astype(np.int64)
    return np.column_stack([lower + origin, axis])


def reduce_triangles(vertices: np.ndarray, faces: np.ndarray, triangles: int) -> tuple[np.ndarray, np.ndarray]:
    """Reduce a surface to `triangles`, or some fewer; a surface of no more stays as it is.

    UserError if none would be left, or if the rims of the surface need more.
    """
    if len(faces) <= triangles:
        return vertices, faces
    from fast_simplification import simplify

    before = len(faces) + 1
    while triangles < len(faces) < before:  # a call ends where what is left costs too much for its first errors
        before = len(faces)
        vertices, faces = simplify(vertices, faces, target_count=triangles)
    if len(faces) > triangles:
        raise UserError(f"--triangles {triangles} is too few for the rims of this mesh; give {len(faces)} or more")
    # Two faces with the same corners are left of what has closed, back to back.
    _, same, times = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
    used, faces = np.unique(faces[times[same.reshape(-1)] == 1], return_inverse=True)
    if not len(faces):
        raise UserError(f"--triangles {triangles} leaves nothing of the mesh; give more")
    return vertices[used].astype(np.float32), faces.reshape(-1, 3).astype(np.int32)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 3) float32, of unit length: means of those of the faces around, by their areas."""
    vectors = area_vectors(vertices, faces)
    sums = [np.bincount(faces.ravel(), np.repeat(values, 3), len(vertices)) for values in vectors.T]
    normals = np.stack(sums, axis=1)
    return (normals / np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-30)).astype(np.float32)
