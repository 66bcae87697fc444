"""Poses by the tracks of structure from motion: where views start, and how strongly tracks hold them there."""

from collections.abc import Sequence

import numpy as np

from scene.readers.tracks import Track
from scene.reprojection import BOUND, nearest_pose, pull

_ANCHOR = 1e-3  # weight of each point's squared reprojection error (pixels) in the loss of its view


class TrackedPoses:
    """The poses of least reprojection error of views. The error, to second order about there, is a part of their loss.

    starts: (4, 4) float64 for each view. held: the error's curvature by the twist there; None for a view without a
    track, which nothing holds. A start counts as the pose of least error, also where the dataset's pose stayed.
    """

    def __init__(
        self, given: Sequence[np.ndarray], tracks: Sequence[Track | None], focals: Sequence[float], unit: float
    ) -> None:
        """given: the dataset's poses. tracks, focals, unit: as of `pull` (scene/reprojection.py)."""
        self.starts, self.held = [], []
        for pose, track, focal in zip(given, tracks, focals, strict=True):
            start = nearest_pose(pose, track, focal, unit, BOUND)
            self.starts.append(start)
            self.held.append(track and pull(start, track, focal, unit).curvature)

    def pulled(self, view: int, twist: np.ndarray) -> np.ndarray | None:
        """The gradient of a view's error by its twist, which is now `twist`; None if not held."""
        curvature = self.held[view]
        return None if curvature is None else _ANCHOR * np.einsum("jk,k->j", curvature, twist)
