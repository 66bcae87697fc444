"""Pinhole geometry. Camera frame: x right, y down, z forward."""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from utils.system_utils import UserError

_NOT_MOVED = np.zeros(3)
_ROUNDED = 1e-4  # largest departure from scale 1 that is left alone: poses written with four decimals have it
_SHEARED = 3e-3  # largest ratio of stretches, less 1, that is taken: poses written with three decimals have 2.1e-3
_SCALED = 1e6  # largest scale, and 1 over the smallest; beyond lie damaged files


class BasicPointCloud(NamedTuple):
    """Coloured points: points (N,3), world units; colors (N,3) float32 in [0,1]; normals (N,3) float32.

    Points are float64 in the world, and float32 in the frame of the training (scene/readers/info.py).
    """

    points: np.ndarray
    colors: np.ndarray
    normals: np.ndarray


def rigid_pose(R: np.ndarray, t: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Divide out the scale that some programs put into a pose: return R and t for `world_to_camera`.

    R is a rotation times a scale. Division of R and t by the scale changes neither the camera's centre nor its image. A
    scale within rounding of 1 changes nothing. UserError, naming the photo, if R is mirrored, sheared or no rotation at
    all, or if a number is not finite.
    """
    matrix, shift = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
    if not (np.isfinite(matrix).all() and np.isfinite(shift).all()):
        raise UserError(f"the pose of {name} is not finite; take the photo out of the scene")
    stretch = np.linalg.svd(matrix, compute_uv=False)
    if not (stretch[0] <= (1 + _SHEARED) * stretch[2] and 1 / _SCALED <= stretch[0] <= _SCALED):
        raise UserError(
            f"the pose of {name} has no valid rotation: its matrix scales by {stretch[2]:.4g} to {stretch[0]:.4g}; "
            "export the cameras again, or take the photo out of the scene"
        )
    if np.linalg.det(matrix) < 0:
        raise UserError(
            f"the pose of {name} is mirrored, as its determinant is negative; negate one coordinate of all cameras and "
            "points, or swap two, so that the axes are right-handed"
        )
    scale = float(f"{stretch.mean():.6g}")  # of 2 R exactly 2, so that both give the same bits
    return (R, t) if abs(scale - 1) <= _ROUNDED else (matrix / scale, shift / scale)


def world_to_camera(R: np.ndarray, t: np.ndarray, translate: np.ndarray = _NOT_MOVED, scale: float = 1.0) -> np.ndarray:
    """World-to-camera matrix (4,4) float64 of a camera-to-world rotation R (3,3), a world-to-camera translation t (3,).

    translate (3,), scale: put the camera's centre c at (c + translate) * scale.
    """
    matrix = np.eye(4)
    matrix[:3, :3] = np.transpose(R)
    matrix[:3, 3] = t
    if scale != 1 or np.any(translate):
        matrix[:3, 3] = -matrix[:3, :3] @ ((camera_center(R, t) + translate) * scale)
    return matrix


def camera_center(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Centre (3,) of a camera in the world. R (3,3): camera-to-world rotation; t (3,): world-to-camera translation.

    If R is no rotation, as in a scaled pose, its inverse is used.
    """
    R = np.asarray(R)
    is_rotation = np.abs(R.T @ R - np.eye(3)).max() <= 1e-3
    return -R @ t if is_rotation else -np.linalg.solve(R.T, t)


def getWorld2View(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """World-to-camera matrix (4,4) float32 of a camera-to-world rotation R (3,3) and world-to-camera translation t."""
    return world_to_camera(R, t).astype(np.float32)


def getWorld2View2(R: np.ndarray, t: np.ndarray, translate: np.ndarray = _NOT_MOVED, scale: float = 1.0) -> np.ndarray:
    """Do as `world_to_camera`; float32."""
    return world_to_camera(R, t, translate, scale).astype(np.float32)


def projection(
    znear: float, zfar: float, fovX: float, fovY: float, offsetX: float = 0.0, offsetY: float = 0.0
) -> Tensor:
    """Perspective matrix (4,4) float64 for column vectors: x, y to [-1,1], depth z in [znear, zfar] to [0,1].

    fovX, fovY: opening angles in radians of a frustum of the image's size. offsetX, offsetY: principal point minus
    image centre in NDC (half image sizes), so 2 cx / W - 1 for COLMAP's cx, with pixel centres at .5.
    """
    rows = [
        [1 / math.tan(fovX / 2), 0, offsetX, 0],
        [0, 1 / math.tan(fovY / 2), offsetY, 0],
        [0, 0, zfar / (zfar - znear), -zfar * znear / (zfar - znear)],
        [0, 0, 1, 0],
    ]
    return torch.tensor(rows, dtype=torch.float64)


def getProjectionMatrix(znear: float, zfar: float, fovX: float, fovY: float) -> Tensor:
    """`projection` of a principal point in the middle; float32."""
    return projection(znear, zfar, fovX, fovY).float()


def geom_transform_points(points: Tensor, transf_matrix: Tensor) -> Tensor:
    """Points (N,3) under a transposed (4,4) matrix, divided by w + 1e-7: (N,3)."""
    moved = torch.cat([points, torch.ones_like(points[:, :1])], dim=1) @ transf_matrix
    return moved[:, :3] / (moved[:, 3:] + 1e-7)


def fov2focal(fov: float, pixels: float) -> float:
    """Focal length in pixels of an opening angle in radians over a size in pixels."""
    return pixels / (2 * math.tan(fov / 2))


def focal2fov(focal: float, pixels: float) -> float:
    """Opening angle in radians of a focal length in pixels over a size in pixels."""
    return 2 * math.atan(pixels / (2 * focal))
