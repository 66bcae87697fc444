"""Views around a model that has no cameras."""

import numpy as np
import torch

from scene.cameras import ZFAR, ZNEAR, MiniCam
from utils.graphics_utils import projection, world_to_camera

_FOV = 0.9  # radians, in both directions
_UP = 0.3  # height of the cameras, in distances from the middle


def orbit(means: np.ndarray, count: int, side: int) -> list[MiniCam]:
    """Square views of `side` pixels on a circle around the middle of positions (N, 3), looking at it, -y up.

    The circle's radius is 2.5 times the median distance from the middle.
    """
    middle = np.median(means, axis=0).astype(np.float64)
    radius = 2.5 * float(np.median(np.linalg.norm(means - middle, axis=1))) + 1e-6
    views = []
    for angle in np.arange(count) * 2 * np.pi / count + 0.3:
        offset = np.array([np.sin(angle), -_UP, np.cos(angle)])
        forward = -offset / np.linalg.norm(offset)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        turn = np.stack([right, np.cross(forward, right), forward], axis=1)  # camera to world
        view = torch.from_numpy(world_to_camera(turn, -turn.T @ (middle + radius * offset)))
        project = projection(ZNEAR, ZFAR, _FOV, _FOV)
        matrices = [matrix.T.to(torch.float32).contiguous() for matrix in (view, project @ view)]
        views.append(MiniCam(side, side, _FOV, _FOV, ZNEAR, ZFAR, *matrices))
    return views
