"""A texture for a mesh: a flat layout by xatlas, and colours of the surface under each of its pixels."""

import sys

import numpy as np
from PIL import Image, ImageDraw

from applications.export.mesh_cleaning import area_vectors
from applications.export.mesh_colors import average_colors
from applications.export.surfaces import Surfaces

_LARGEST = 4096  # pixels of the longer side that are asked for; gaps between charts take more
_GAP = 4  # pixels between charts, so that smaller copies of the image do not mix them
_GROUP = 1000  # triangles that are laid out at once: the time for more grows faster than their number
_AT_ONCE = 1 << 20  # pixels


def make_texture(
    vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, surfaces: Surfaces, voxel: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, None, np.ndarray, np.ndarray]:
    """The values of a `Mesh` with a texture. Vertices where charts meet are there for each chart."""
    print(f"Laying out {len(faces):,} triangles in an image", file=sys.stderr)
    area = np.linalg.norm(area_vectors(vertices, faces), axis=1).sum() / 2
    rows, faces, uv, size = _lay_out(vertices, faces, normals, int(min(_LARGEST, area**0.5 / surfaces.pixel)))
    vertices, normals = vertices[rows], normals[rows]
    owners = find_owners(faces, uv * size, size)
    covered = owners >= 0
    of, pixels = faces[owners[covered]], np.argwhere(covered)[:, ::-1] + 0.5
    points, sides = np.empty((2, len(of), 3), np.float32)
    for start in range(0, len(of), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        shares = barycentric(uv * size, of[part], pixels[part])
        points[part], sides[part] = (
            np.einsum("nk,nkc->nc", shares, values[of[part]]) for values in (vertices, normals)
        )
    image = np.zeros((*covered.shape, 3), np.uint8)
    colors, seen = average_colors(points, sides, surfaces, voxel)
    image[covered] = colors
    covered[covered] = seen
    return vertices, faces, normals, None, uv, _fill_gaps(image, covered)


def _lay_out(
    vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, resolution: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The old row of each new vertex, new faces, places (V, 2) float32 in [0, 1], and the image's size (2,) in pixels.

    resolution: the size, roughly.
    """
    import xatlas

    atlas, given = xatlas.Atlas(), []
    for group in _group_faces(vertices[faces].mean(axis=1), np.arange(len(faces))):
        used, local = np.unique(faces[group], return_inverse=True)
        atlas.add_mesh(vertices[used], local.reshape(-1, 3).astype(np.uint32), normals[used])
        given.append(used)
    options = xatlas.PackOptions()
    options.resolution, options.padding = resolution, _GAP
    atlas.generate(pack_options=options)
    rows, triangles, uv, count = [], [], [], 0
    for number, used in enumerate(given):
        back, local, places = atlas.get_mesh(number)
        rows.append(used[back])
        triangles.append(local.astype(np.int32) + count)
        uv.append(places)
        count += len(back)
    size = np.array([atlas.width, atlas.height])
    return np.concatenate(rows), np.concatenate(triangles), np.concatenate(uv), size


def _group_faces(middles: np.ndarray, rows: np.ndarray) -> list[np.ndarray]:
    """Rows of faces in boxes, halved until each has _GROUP at most. middles (F, 3)."""
    if len(rows) <= _GROUP:
        return [rows]
    half, axis = len(rows) // 2, np.ptp(middles[rows], axis=0).argmax()
    order = rows[np.argpartition(middles[rows, axis], half)]
    return _group_faces(middles, order[:half]) + _group_faces(middles, order[half:])


def find_owners(faces: np.ndarray, pixels: np.ndarray, size: np.ndarray) -> np.ndarray:
    """(H, W) int32: the face that each pixel of the image is of, -1 for none. pixels (V, 2): vertices in the image."""
    image = Image.new("I", tuple(size.tolist()), -1)
    draw = ImageDraw.Draw(image)
    for number, corners in enumerate(pixels[faces].reshape(-1, 6).tolist()):
        draw.polygon(corners, fill=number)
    return np.asarray(image)


def barycentric(pixels: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(P, 3): places of points (P, 2) in the triangles of `faces` (P, 3), moved into these."""
    a, b, c = (pixels[faces[:, k]].astype(np.float64) for k in range(3))
    along, across, inner = b - a, c - a, points - a
    area = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
    area = np.where(np.abs(area) < 1e-9, np.inf, area)
    second = (inner[:, 0] * across[:, 1] - inner[:, 1] * across[:, 0]) / area
    third = (along[:, 0] * inner[:, 1] - along[:, 1] * inner[:, 0]) / area
    places = np.stack([1 - second - third, second, third], axis=1).clip(0, None)
    return places / places.sum(axis=1, keepdims=True)


def _fill_gaps(image: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """The image with the nearest covered pixel's colour everywhere else."""
    from scipy.ndimage import distance_transform_edt

    nearest = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    return image[tuple(nearest)]
