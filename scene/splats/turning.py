"""Splats in worlds of other axes."""

from dataclasses import replace

import numpy as np
import torch

from scene.splats.splats import Splats
from utils.sh_utils import sh_basis

_DIRECTIONS = 64  # more than the 25 coefficients that they determine
_AXES = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}


def from_axes(splats: Splats, axes: str) -> Splats:
    """Splats whose x, y and z point as three letters say: right, left, down, up, forward (F) or back; in our axes.

    A world of left-handed axes is a mirror image of ours. A Gaussian keeps its shape if all is mirrored at its middle,
    which changes the sign of odd SH bands; what is left is a rotation.
    """
    turn = np.array([_AXES[axis] for axis in axes], np.float64).T
    if np.linalg.det(turn) < 0:
        odd = np.floor(np.sqrt(np.arange(splats.sh.shape[1]))) % 2 == 1
        splats = replace(splats, means=-splats.means, sh=np.where(odd[:, None], -splats.sh, splats.sh))
        turn = -turn
    return turned(splats, turn)


def turned(splats: Splats, turn: np.ndarray) -> Splats:
    """The same Gaussians in a world turned by a rotation (3,3); its offset is not kept."""
    from scipy.spatial.transform import Rotation  # it takes a while to import

    rotation = Rotation.from_matrix(turn) * Rotation.from_quat(splats.rotations, scalar_first=True)
    return replace(
        splats,
        means=(splats.means @ turn.T).astype(np.float32),
        rotations=rotation.as_quat(scalar_first=True).astype(np.float32),
        sh=np.einsum("jk,nkc->njc", _sh_turn(splats.sh_degree, turn).astype(np.float32), splats.sh),
        world_offset=(0.0, 0.0, 0.0),
    )


def _sh_turn(degree: int, turn: np.ndarray) -> np.ndarray:
    """The matrix (K,K) of SH coefficients: the new function at a direction d is the old one at turn^T d."""
    directions = torch.randn(_DIRECTIONS, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    directions = torch.nn.functional.normalize(directions)
    new, old = sh_basis(degree, directions), sh_basis(degree, directions @ torch.from_numpy(turn))
    return torch.linalg.lstsq(new, old).solution.numpy()
