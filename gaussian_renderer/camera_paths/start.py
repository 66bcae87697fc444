"""The first camera of exported pages and of the viewer, and the part of its photo that a window shows."""

import math

import numpy as np

from gaussian_renderer.camera_paths.poses import Poses, focus_point

LEAST, MOST = 0.85, 2.0  # of a photo's sides that is shown, whatever the window's shape; of its height, at most
_ALIKE = 1e-3  # scores that differ by less are equal
_FARTHER = 1.5  # of the usual distance: from there a view shows more of the middle, and no less well


def best_start(poses: Poses) -> int:
    """Index of the camera that looks most directly at the common focus, from a usual distance or somewhat farther.

    The first of equals. One radian off the axis counts as much as being nearer, or too far, by a factor of e.
    """
    focus = focus_point(poses)
    if focus is None:
        return 0
    offsets = focus - poses.positions
    distances = np.linalg.norm(offsets, axis=1).clip(1e-9)
    angles = np.arccos(np.clip((offsets * poses.forward).sum(1) / distances, -1, 1))
    usual = np.median(distances)
    scores = angles + np.abs(np.log(distances / np.clip(distances, usual, _FARTHER * usual)))
    return int(np.argmax(scores <= scores.min() + _ALIKE))


def narrow_fov(fov: float, photo: float, window: float) -> float:
    """The vertical opening angle, radians, at which a photo fills a window, and LEAST of its width or height is shown.

    The window shows at most MOST times the photo's height. page.js has the same formula.

    fov: the photo's vertical opening angle, radians.
    photo, window: width over height.
    """
    share = photo / window
    heights = max(share, LEAST) if share < 1 else min(max(1.0, LEAST * share), MOST)
    return 2 * math.atan(math.tan(fov / 2) * heights)
