"""Poses of a browser's camera, checked: they come over the network."""

import math
from typing import TYPE_CHECKING

from viewing.settings import Pose

if TYPE_CHECKING:
    import viser

_WIDEST = 8192  # pixels of a window's side
_SLIMMEST = 10  # ratio of its sides


def pose_of(camera: "viser.CameraHandle") -> Pose | None:
    """The pose and window of a browser's camera, None for one that cannot be drawn."""
    position, wxyz = [float(x) for x in camera.position], [float(x) for x in camera.wxyz]
    fov, length = float(camera.fov), math.hypot(*wxyz)
    if not all(map(math.isfinite, (*position, *wxyz, fov))) or not 0 < fov < math.pi or not 1e-6 < length < 1e6:
        return None
    return Pose(tuple(position), tuple(x / length for x in wxyz), fov, *window_of(camera))


def window_of(camera: "viser.CameraHandle") -> tuple[int, int]:
    """Width and height, in pixels, of a browser's window; sides that cannot be drawn count as the nearest that can."""
    width, height = (min(max(int(side), 1), _WIDEST) for side in (camera.image_width, camera.image_height))
    return max(width, height // _SLIMMEST), max(height, width // _SLIMMEST)
