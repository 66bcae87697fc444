"""Pinhole geometry. Camera frame: x right, y down, z forward."""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor


class BasicPointCloud(NamedTuple):
    """Coloured points: points (N,3), world units; colors (N,3) float32 in [0,1]; normals (N,3) float32.

    Points are float64 in the world, and float32 in the frame of the training (scene/readers/world_offset.py).
    """

    points: np.ndarray
    colors: np.ndarray
    normals: np.ndarray


def getWorld2View2(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """World-to-camera matrix (4,4) float64 of a camera-to-world rotation R (3,3) and world-to-camera translation t."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.transpose(R)
    matrix[:3, 3] = t
    return matrix


def getProjectionMatrix(
    znear: float, zfar: float, fovX: float, fovY: float, offsetX: float = 0.0, offsetY: float = 0.0
) -> Tensor:
    """Perspective matrix (4,4) float64 for column vectors: x, y to [-1,1], depth z in [znear, zfar] to [0,1].

    fovX, fovY: opening angles in radians of a frustum of the image's size. offsetX, offsetY: principal point minus
    image centre in NDC (half image sizes), so 2 cx / W - 1 for COLMAP's cx, with pixel centres at .5.
    """
    P = torch.zeros(4, 4, dtype=torch.float64)
    P[0, 0] = 1 / math.tan(fovX / 2)
    P[1, 1] = 1 / math.tan(fovY / 2)
    P[0, 2] = offsetX
    P[1, 2] = offsetY
    P[2, 2] = zfar / (zfar - znear)
    P[2, 3] = -zfar * znear / (zfar - znear)
    P[3, 2] = 1
    return P


def fov2focal(fov: float, pixels: float) -> float:
    """Focal length in pixels of an opening angle in radians over a size in pixels."""
    return pixels / (2 * math.tan(fov / 2))


def focal2fov(focal: float, pixels: float) -> float:
    """Opening angle in radians of a focal length in pixels over a size in pixels."""
    return 2 * math.atan(pixels / (2 * focal))
