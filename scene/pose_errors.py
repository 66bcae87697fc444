"""How far points lie from where photos show them, with the given poses and with the best ones."""

from collections.abc import Sequence

import numpy as np

from scene.readers.info import CameraInfo
from scene.readers.tracks import Track
from scene.reprojection import BOUND, nearest_pose, pull
from utils.graphics_utils import world_to_camera

COMPARED = 16  # views whose tracks are looked at
ADJUSTED = 0.5  # median error of points with better poses, as a part of that with the given ones,
_SEEN = 0.2  # if that is more pixels


def pose_errors(
    views: Sequence[CameraInfo], tracks: Sequence[Track | None], extent: float
) -> tuple[float, float] | None:
    """Pixels from points to where photos show them (median), with their poses and with the best ones; None: no tracks.

    Of COMPARED views.
    """
    errors, step = [], max(1, len(views) // COMPARED)
    for view, track in zip(views[::step], tracks[::step], strict=True):
        if track is None:
            continue
        given = world_to_camera(view.R, view.T)
        best = nearest_pose(given, track, view.fx, extent, BOUND)
        errors.append([np.median(pull(pose, track, view.fx, extent).size) for pose in (given, best)])
    return tuple(np.median(errors, axis=0).tolist()) if errors else None


def poses_differ(given: float, best: float) -> bool:
    """Whether better poses fit the tracks far better (`pose_errors`)."""
    return given > _SEEN and best < ADJUSTED * given
