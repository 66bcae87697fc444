"""The spherical harmonics, of the oracle and of the kernels, against SciPy's."""

import numpy as np
import torch
from diff_gaussian_rasterization.reference.colour import sh_basis
from scipy.special import sph_harm_y


def real_harmonics(directions: np.ndarray) -> np.ndarray:
    """The basis (N, 16) at unit vectors (N, 3), in the order (l, m) = (0, 0), (1, -1), (1, 0), ...

    It is sqrt(2) times the real (m > 0) or imaginary (m < 0) part of the complex basis, with Condon-Shortley's sign.
    """
    theta, phi = np.arccos(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
    columns = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            y = sph_harm_y(degree, abs(order), theta, phi)
            columns.append(y.real if order == 0 else 2**0.5 * (y.real if order > 0 else y.imag))
    return np.stack(columns, 1)


def directions(n: int) -> np.ndarray:
    v = np.random.default_rng(0).normal(size=(n, 3))
    v[:, 2] = np.abs(v[:, 2]) + 0.4  # in front of a camera at the origin
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def test_the_oracles_basis():
    d = np.concatenate([directions(50), -directions(50)])
    np.testing.assert_allclose(sh_basis(torch.tensor(3.7 * d)).numpy(), real_harmonics(d), rtol=0, atol=1e-13)
