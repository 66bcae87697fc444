"""The point that cameras look at."""

import numpy as np

from moving_cameras.poses import Poses

# Mean squared sine of the angles between the axes, about, below which no point is found: 1.8 degrees.
PARALLEL = 1e-3


def focus_point(poses: Poses) -> np.ndarray | None:
    """The point (3,) nearest to all optical axes, None if these are parallel or most cameras look away from it.

    Least squares: the sum of (I - d d^T) (x - c) over the axes from c along d is zero (Traa, "Least-squares
    intersection of lines", 2013).
    """
    axes = poses.forward
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    matrix, side = across.mean(axis=0), (across @ poses.positions[:, :, None]).mean(axis=0)[:, 0]
    if np.linalg.eigvalsh(matrix)[0] < PARALLEL:
        return None
    point = np.linalg.solve(matrix, side)
    ahead = ((point - poses.positions) * axes).sum(axis=1)
    return point if np.median(ahead) > 0 else None
