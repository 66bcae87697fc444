"""Clusters of points of a cloud in one place, exactly or within rounding, as in merged clouds."""

from typing import NamedTuple

import numpy as np

NEAR = 1e-5  # of the median distance from the cloud's middle; points of real scenes that are nearer are the same point
MANY = 0.25  # share of a cloud's points that share a place; structure from motion leaves up to 0.08, all of them pairs
HIDING = 4  # points in one place: each has three neighbours at no distance, and with them no size
_MIX = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)


class Clusters(NamedTuple):
    """The clusters of a cloud: a point's index for each (P,); each point's cluster (N,); points of each (P,)."""

    points: np.ndarray
    of_point: np.ndarray
    counts: np.ndarray

    @property
    def shared(self) -> float:
        """Share of the points that are not alone in their cluster."""
        return float(self.counts[self.counts > 1].sum() / max(len(self.of_point), 1))

    @property
    def hides_spacing(self) -> bool:
        """True if distances between points say little about the distances between clusters."""
        return self.shared > MANY or int(self.counts.max(initial=0)) >= HIDING


def clusters_of(points: np.ndarray) -> Clusters:
    """Cluster points (N, 3), which are finite. Two points are in one cluster if they are nearer than NEAR."""
    points = np.asarray(points, dtype=np.float64)
    middle = np.median(points, axis=0) if len(points) else np.zeros(3)
    size = float(np.median(np.linalg.norm(points - middle, axis=1))) if len(points) else 0.0
    cell = 2 * NEAR * size or 1e-30
    chosen, places = np.arange(len(points)), np.arange(len(points))
    for shift in (0.0, 0.5):  # a border of cells parts neighbours, but hardly two that are shifted against each other
        chosen, places = _merge_clusters(points, middle, cell, shift, chosen, places)
    return Clusters(chosen, places, np.bincount(places, minlength=len(chosen)))


def _merge_clusters(
    points: np.ndarray, middle: np.ndarray, cell: float, shift: float, chosen: np.ndarray, places: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Merge the clusters in each cell of a grid."""
    cells = np.clip(np.floor((points[chosen] - middle) / cell + shift), -(2.0**62), 2.0**62).astype(np.int64)
    with np.errstate(over="ignore"):
        keys = (cells.view(np.uint64) * _MIX).sum(axis=1, dtype=np.uint64)
        keys = (keys ^ (keys >> np.uint64(29))) * _MIX[0]
    _, first, of_place = np.unique(keys, return_index=True, return_inverse=True)
    return chosen[first], of_place.reshape(-1)[places]
