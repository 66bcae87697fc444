"""A view from any pose, without a photo."""

import math
from collections.abc import Sequence

import numpy as np
import torch

from scene.cameras import ZFAR, ZNEAR, MiniCam
from utils.graphics_utils import projection, world_to_camera


def free_view(
    width: int, height: int, fov_y: float, position: Sequence[float], wxyz: Sequence[float], device: torch.device | str
) -> MiniCam:
    """A view of square pixels. fov_y: radians. position: of the camera in the world.

    wxyz: unit quaternion that turns camera axes (x right, y down, z forward) into world axes.
    """
    fov_x = 2 * math.atan(math.tan(fov_y / 2) * width / height)
    turn = rotation_matrix(wxyz)
    view = torch.from_numpy(world_to_camera(turn, -turn.T @ np.asarray(position, np.float64)))
    project = projection(ZNEAR, ZFAR, fov_x, fov_y)
    matrices = [m.T.to(device, torch.float32).contiguous() for m in (view, project @ view)]
    return MiniCam(width, height, fov_y, fov_x, ZNEAR, ZFAR, *matrices)


def rotation_matrix(wxyz: Sequence[float]) -> np.ndarray:
    """The rotation (3,3) float64 of a unit quaternion."""
    w, x, y, z = map(float, wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
