"""Poses by the tracks of structure from motion: where views start, and how strongly tracks hold them there."""

from collections.abc import Sequence

import numpy as np

from scene.readers.tracks import Track
from scene.reprojection import BOUND, damped, nearest_pose, pull

_ANCHOR = 1e-3  # weight of each point's squared reprojection error (pixels) in the loss of its view


class TrackedPoses:
    """The poses of least reprojection error of views. The error, to second order about there, is a part of their loss.

    starts: (4, 4) float64 for each view. held: gradient and curvature of the error by the twist there, and by the
    change of a lens where slopes are given; None for a view without a track, which nothing holds. A start counts as the
    pose of least error, also where the dataset's pose stayed.
    """

    def __init__(
        self,
        given: Sequence[np.ndarray],
        tracks: Sequence[Track | None],
        focals: Sequence[float],
        slopes: Sequence[np.ndarray | None],
        unit: float,
    ) -> None:
        """given: the dataset's poses. tracks, focals, slopes, unit: as of `pull` (scene/reprojection.py)."""
        self.starts, self.held = [], []
        for pose, track, focal, slope in zip(given, tracks, focals, slopes, strict=True):
            start = nearest_pose(pose, track, focal, unit, BOUND)
            of_track = track and pull(start, track, focal, unit, slope)
            if of_track:
                of_track.gradient[:6] = 0
            self.starts.append(start)
            self.held.append(of_track and (of_track.gradient, of_track.curvature))

    def pulled(self, view: int, moved: np.ndarray) -> np.ndarray | None:
        """The gradient of a view's error by its twist, and by its lens, after these have moved; None if not held."""
        if self.held[view] is None:
            return None
        at_start, curvature = self.held[view]
        return _ANCHOR * (at_start + np.einsum("jk,k->j", curvature, moved))

    def settled(self, view: int, change: np.ndarray) -> np.ndarray:
        """The twist (6,) of least error of a view whose lens has changed."""
        if self.held[view] is None:
            return np.zeros(6)
        _, curvature = self.held[view]
        return -np.linalg.solve(damped(curvature[:6, :6]), curvature[:6, 6:] @ change)
