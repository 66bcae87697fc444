"""Rotations of all photos from the rotations between pairs, by averaging that leaves wrong pairs out.

A pair counts by how well its rotation is known, and by the share of the triangles of pairs it is in whose rotations
lead back to the start. Reweighted least squares go from absolute errors to Geman and McClure's loss (Chatterjee and
Govindu 2018).
"""

import numpy as np
import scipy.linalg
import scipy.sparse
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from applications.convert.global_sfm.relative_poses import rotate_by

_EXACT = np.radians(0.1)  # no pair is more exact
_FIRST, _ROUNDS = 10, 60  # with absolute errors; in all
_DONE = 1e-5  # radians
_CLOSED = np.radians(1.0)  # error of a triangle, beside three standard deviations
_CONSISTENT = 0.1  # share of closed triangles of a pair that is used


def rotation_vectors(rotations: np.ndarray) -> np.ndarray:
    """Return axis times angle (N, 3), radians, of rotations (N, 3, 3)."""
    angle = np.arccos(np.clip((np.trace(rotations, axis1=1, axis2=2) - 1) / 2, -1, 1))
    odd = (rotations - rotations.swapaxes(1, 2))[:, [2, 0, 1], [1, 2, 0]] / 2
    length = np.linalg.norm(odd, axis=1)
    return odd * np.where(length > 1e-9, angle / np.maximum(length, 1e-9), 1.0)[:, None]


def average_rotations(pairs: np.ndarray, rotations: np.ndarray, spreads: np.ndarray) -> dict[int, np.ndarray]:
    """Return the rotation (3, 3) from the world to the camera, by photo, for the largest set that pairs connect.

    pairs (P, 2): photos, the lower number first. rotations (P, 3, 3): from the first one's frame to the second's.
    spreads (P,): standard deviations, radians.
    """
    closed = closed_triangles(pairs, rotations, spreads)
    kept = closed > _CONSISTENT
    if not kept.any():
        return {}
    photos, ends = np.unique(pairs[kept], return_inverse=True)
    ends = ends.reshape(-1, 2)
    rotations, spreads = rotations[kept], spreads[kept] / np.sqrt(closed[kept])
    photos, ends, inside = _keep_largest_part(photos, ends)
    rotations, spreads = rotations[inside], spreads[inside]
    one, other = ends.T
    found = _chain_rotations(len(photos), ends, rotations, spreads)
    certain = 1 / (spreads**2 + _EXACT**2)
    for number in range(_ROUNDS):
        between = rotations @ found[one] @ found[other].swapaxes(1, 2)
        error = np.einsum("nji,nj->ni", found[other], rotation_vectors(between))  # in the world's frame
        size = np.linalg.norm(error, axis=1)
        if number < _FIRST:
            weight = np.sqrt(certain) / np.maximum(size, _EXACT)
        else:
            weight = certain / (1 + (size / np.maximum(5 / np.sqrt(certain), _CLOSED)) ** 2) ** 2
        step = _solve_laplacian(len(photos), ends, weight, error)
        found = found @ rotate_by(step)
        if number > _FIRST and np.abs(step).max() < _DONE:
            break
    return dict(zip(photos.tolist(), found, strict=True))


def closed_triangles(pairs: np.ndarray, rotations: np.ndarray, spreads: np.ndarray) -> np.ndarray:
    """Return for each pair the share (P,) of its triangles whose rotations lead back to the start.

    A pair without triangles has a half.
    """
    edge = {(int(one), int(other)): number for number, (one, other) in enumerate(pairs)}
    near: dict[int, set[int]] = {}
    for one, other in edge:
        near.setdefault(one, set()).add(other)
    found = [
        (number, edge[other, third], edge[one, third])
        for (one, other), number in edge.items()
        for third in sorted(near[one] & near.get(other, set()))
    ]
    sides = np.array(found, int).reshape(-1, 3)
    first, second, third = sides.T
    back = rotations[third].swapaxes(1, 2) @ rotations[second] @ rotations[first]
    wide = _CLOSED + 3 * np.sqrt((spreads[sides] ** 2).sum(1))
    is_closed = np.linalg.norm(rotation_vectors(back), axis=1) < wide
    counts = [np.bincount(some.ravel(), minlength=len(pairs)) for some in (sides[is_closed], sides)]
    return (counts[0] + 0.5) / (counts[1] + 1)


def _keep_largest_part(photos: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Keep the largest set of connected photos; return them, their pairs renumbered, and which pairs these are."""
    graph = scipy.sparse.coo_matrix((np.ones(len(ends)), ends.T), (len(photos),) * 2)
    part = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    chosen = part == np.bincount(part).argmax()
    inside = chosen[ends[:, 0]]
    return photos[chosen], (np.cumsum(chosen) - 1)[ends[inside]], inside


def _chain_rotations(count: int, ends: np.ndarray, rotations: np.ndarray, spreads: np.ndarray) -> np.ndarray:
    """Chain rotations along the tree of the best known pairs, from the photo with most pairs."""
    tree = minimum_spanning_tree(scipy.sparse.coo_matrix((spreads + 1e-9, ends.T), (count, count)).tocsr())
    root = int(np.bincount(ends.ravel(), minlength=count).argmax())
    order, before = breadth_first_order(tree + tree.T, root, directed=False)
    edge = {(int(one), int(other)): number for number, (one, other) in enumerate(ends)}
    found = np.tile(np.eye(3), (count, 1, 1))
    for photo in order[1:].tolist():
        last = int(before[photo])
        forward = edge.get((last, photo))
        turn = rotations[edge[photo, last]].T if forward is None else rotations[forward]
        found[photo] = turn @ found[last]
    return found


def _solve_laplacian(count: int, ends: np.ndarray, weight: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return the vectors (count, 3) whose differences over the pairs fit the errors best; the first one stays zero."""
    one, other = ends.T
    rows, columns = np.concatenate([one, other, one, other]), np.concatenate([one, other, other, one])
    values = np.concatenate([weight, weight, -weight, -weight])
    matrix = scipy.sparse.coo_matrix((values, (rows, columns)), (count, count)).toarray()
    pull = np.stack(
        [np.bincount(other, part, count) - np.bincount(one, part, count) for part in (weight[:, None] * error).T], 1
    )
    matrix[np.diag_indices(count)] += 1e-9 * matrix.max()  # a photo may have wrong pairs only, which hardly count
    step = np.zeros((count, 3))
    if count > 1:
        step[1:] = scipy.linalg.solve(matrix[1:, 1:], pull[1:], assume_a="pos", check_finite=False)
    return step
