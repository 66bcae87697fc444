"""Order in which a path visits cameras."""

import numpy as np

from moving_cameras.poses import Poses

MOST = 1000  # cameras that are looked at: the distances of all pairs take 8 MB
_PASSES = 50


def distances(one: Poses, other: Poses, radius: float) -> np.ndarray:
    """How far poses are from others, pairwise: distance moved plus radius x radians turned (N,), in world units."""
    moved = np.linalg.norm(one.positions - other.positions, axis=1)
    cosine = np.abs((one.quaternions * other.quaternions).sum(axis=1))
    return moved + radius * 2 * np.arccos(np.minimum(cosine, 1.0))


def turning_radius(poses: Poses) -> float:
    """What a turn of one radian counts in `distances`: as much as walking the cameras' mean distance from their middle.

    1 where the cameras are all in one place.
    """
    return poses.spread or 1.0


def visiting_order(poses: Poses) -> np.ndarray:
    """Indices of the poses in the order of a path.

    The order given is kept, unless a tour is less than half as long: the nearest camera next, beginning at the first,
    then improved by 2-opt (Croes 1958). So a walk stays as it was filmed, and photos in no order are not criss-crossed.
    Of more than MOST poses, only MOST are taken, evenly.
    """
    kept = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), MOST)).round().astype(int))
    table = _table(poses[kept])
    given = np.arange(len(kept))
    tour = _improved(_nearest_first(table), table)
    return kept[tour if _length(tour, table) < _length(given, table) / 2 else given]


def spread_along(poses: Poses, count: int) -> np.ndarray:
    """Indices of at most `count` poses, spread evenly along the way through all of them, with both ends."""
    if len(poses) <= count:
        return np.arange(len(poses))
    later = np.arange(1, len(poses))
    steps = distances(poses[later - 1], poses[later], turning_radius(poses))
    way = np.concatenate([[0.0], np.cumsum(steps)])
    wanted = np.linspace(0, way[-1], count)
    right = np.searchsorted(way, wanted).clip(1, len(way) - 1)
    return np.unique(np.where(wanted - way[right - 1] < way[right] - wanted, right - 1, right))


def _table(poses: Poses) -> np.ndarray:
    """`distances` of all pairs (N,N)."""
    radius, quaternions = turning_radius(poses), poses.quaternions
    moved = np.stack([np.linalg.norm(poses.positions - position, axis=1) for position in poses.positions])
    return moved + radius * 2 * np.arccos(np.minimum(np.abs(quaternions @ quaternions.T), 1.0))


def _length(order: np.ndarray, table: np.ndarray) -> float:
    return float(table[order[:-1], order[1:]].sum())


def _nearest_first(table: np.ndarray) -> np.ndarray:
    order, left = [0], np.ones(len(table), bool)
    left[0] = False
    while left.any():
        order.append(int(np.where(left, table[order[-1]], np.inf).argmin()))
        left[order[-1]] = False
    return np.array(order)


def _improved(order: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Reverse parts of an open tour as long as that shortens it; its first stays the first."""
    order = order.copy()
    for _ in range(_PASSES):
        before = _length(order, table)
        for start in range(1, len(order) - 1):
            ends = np.arange(start + 1, len(order))
            after = np.append(order[ends[:-1] + 1], -1)  # the last end has no successor
            beyond = np.where(after >= 0, table[order[start], after] - table[order[ends], after], 0.0)
            gain = table[order[start - 1], order[start]] - table[order[start - 1], order[ends]] - beyond
            if gain.max() > 1e-9:
                end = ends[gain.argmax()]
                order[start : end + 1] = order[start : end + 1][::-1]
        if _length(order, table) >= before - 1e-9:
            break
    return order
