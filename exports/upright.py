"""Turn of a model that puts it upright, for viewers whose camera has no roll."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from exports.splats import Splats
from moving_cameras.poses import Poses
from utils.sh_utils import sh_basis

UP = np.array([0.0, -1.0, 0.0])  # of the turned model, as in a usual capture
_MEAN_UP = 0.01  # weight of the mean up beside the cameras' horizons
_DIRECTIONS = 64  # more than the 25 coefficients that they determine


def up_of(poses: Poses) -> np.ndarray:
    """The direction (3,), of length 1, that is up for most cameras: the one in which their rolls are least.

    A level camera has its x axis at right angles to up, however far it looks down. So up is the eigenvector of the
    least eigenvalue of the mean of x x^T; where cameras face one way and leave it open, their mean up decides.
    """
    mean, across = poses.up, poses.turns[:, :, 0]
    mean = mean / max(float(np.linalg.norm(mean)), 1e-9)
    matrix = across.T @ across / len(poses) + _MEAN_UP * (np.eye(3) - np.outer(mean, mean))
    up = np.linalg.eigh(matrix)[1][:, 0]
    return up if up @ mean >= 0 else -up


def turn_upright(up: np.ndarray) -> np.ndarray:
    """The least rotation (3,3) that takes a direction to UP."""
    axis, cosine = np.cross(up, UP), float(up @ UP)
    sine = float(np.linalg.norm(axis))
    axis = axis / sine if sine > 1e-9 else np.array([0.0, 0.0, 1.0])
    return Rotation.from_rotvec(axis * np.arctan2(sine, cosine)).as_matrix()


def turned(splats: Splats, turn: np.ndarray) -> Splats:
    """The same Gaussians in a world turned by a rotation (3,3); its offset is not kept."""
    rotation = Rotation.from_matrix(turn) * Rotation.from_quat(np.roll(splats.rotations, -1, axis=1))
    sh = np.einsum("jk,nkc->njc", _sh_turn(splats.sh_degree, turn).astype(np.float32), splats.sh)
    return Splats(
        (splats.means @ turn.T).astype(np.float32),
        splats.log_scales,
        np.roll(rotation.as_quat(), 1, axis=1).astype(np.float32),
        splats.opacity_logits,
        sh,
        splats.antialiasing,
    )


def _sh_turn(degree: int, turn: np.ndarray) -> np.ndarray:
    """The matrix (K,K) of SH coefficients: the new function at a direction d is the old one at turn^T d."""
    directions = torch.randn(_DIRECTIONS, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    directions = torch.nn.functional.normalize(directions)
    new, old = sh_basis(degree, directions), sh_basis(degree, directions @ torch.from_numpy(turn))
    return torch.linalg.lstsq(new, old).solution.numpy()
