"""A model's values as every format takes them."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Splats:
    """N Gaussians on the CPU, float32, in the raw form of our PLY files.

    means (N,3); log_scales (N,3), natural logarithms; rotations (N,4), wxyz, of length 1; opacity_logits (N,);
    sh (N,K,3), the bands in the reference's order, K = (degree + 1)^2. Axes are those of COLMAP's world: of a usual
    capture x is right, y down, z forward. antialiasing: whether they were trained with --antialiasing. world_offset:
    the world's coordinates of the origin of the means.
    """

    means: np.ndarray
    log_scales: np.ndarray
    rotations: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    antialiasing: bool = False
    world_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        return round(self.sh.shape[1] ** 0.5) - 1
