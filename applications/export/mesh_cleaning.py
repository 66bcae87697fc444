"""Meshes without what is ragged: tongues and threads at their rims, and small islands, which are mostly of floaters."""

import numpy as np

from utils.system_utils import UserError

_WIDTH = 2  # triangles between the rims of what is too narrow to stay, on each side
_SMALL = 0.02
_ROUNDS = 5  # of smoothing


def area_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F, 3) float64: normals of faces, twice as long as the faces are large."""
    a, b, c = vertices[faces.T].astype(np.float64)
    return np.cross(b - a, c - a)


def keep_whole_parts(vertices: np.ndarray, faces: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of the broad and large parts of a mesh. weights (V,): how well views see the vertices.

    UserError where nothing is broad.
    """
    left = trim_narrow_parts(faces, len(vertices))
    if not len(left):
        raise UserError("all surfaces are too narrow for a mesh; give a smaller --voxel, or a larger --crop")
    return keep_large_parts(vertices, left, weights)


def trim_narrow_parts(faces: np.ndarray, count: int) -> np.ndarray:
    """Remove narrow parts of a mesh: shrink its rim by _WIDTH triangles, and grow what is left again.

    count: of vertices.
    """
    left = faces
    for _ in range(_WIDTH):
        at_rim = np.zeros(count, bool)
        at_rim[find_rim_edges(left, count)] = True
        left = left[~at_rim[left].any(axis=1)]
    for _ in range(_WIDTH):
        near = np.zeros(count, bool)
        near[left] = True
        left = faces[near[faces].any(axis=1)]
    return left


def find_rim_edges(faces: np.ndarray, count: int) -> np.ndarray:
    """(E, 2) int64: edges with a face on one side only."""
    ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64), axis=1)
    keys, times = np.unique(ends @ [count, 1], return_counts=True)
    return np.stack(np.divmod(keys[times == 1], count), axis=1)


def keep_large_parts(vertices: np.ndarray, faces: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keep the connected parts with at least a share _SMALL of the pixels that the largest part has in all views.

    The largest one alone would often lack the subject: photos hardly show where it stands on the floor. And what is far
    off in few views, mostly of a wrong shape, can have more triangles than the subject.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count, (a, b, c) = len(vertices), faces.T
    edges = np.concatenate([a, b]), np.concatenate([b, c])
    _, part = connected_components(coo_matrix((np.ones(len(edges[0]), bool), edges), (count, count)), directed=False)
    sizes = np.bincount(part[a], weights[a])
    faces = faces[sizes[part[a]] >= _SMALL * sizes.max()]
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3).astype(np.int32)


def smooth_rims(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The vertices, of which those at a rim have come near to the means of their neighbours there.

    Those of faces that this would turn over stay.
    """
    edges, before, vertices = find_rim_edges(faces, len(vertices)), vertices, vertices.copy()
    used, ends = np.unique(edges, return_inverse=True)
    one, other = ends.reshape(-1, 2).T
    both, across = np.concatenate([one, other]), np.concatenate([other, one])
    times = np.bincount(both, minlength=len(used))[:, None]
    for _ in range(_ROUNDS):
        points = vertices[used]
        means = np.stack([np.bincount(both, values[across], len(used)) for values in points.T], axis=1) / times
        vertices[used] = (points + means) / 2
    over = (area_vectors(before, faces) * area_vectors(vertices, faces)).sum(axis=1) <= 0
    vertices[faces[over]] = before[faces[over]]
    return vertices
