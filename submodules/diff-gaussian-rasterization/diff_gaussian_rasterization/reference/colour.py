"""Colours that depend on the direction of view, as spherical harmonics (Kerbl et al. 2023, section 4)."""

import torch
from torch import Tensor

from diff_gaussian_rasterization.gaussians import Gaussians
from diff_gaussian_rasterization.reference.camera import Camera

# Colours above this get a gradient, so that points that start black (0 up to rounding) can brighten.
LEAST_WITH_GRADIENT = -1e-6


def seen_colors(gaussians: Gaussians, camera: Camera, degree: int) -> Tensor:
    """(N, 3): half, plus the harmonics up to `degree` (0 to 3) towards each mean; negative values become 0."""
    bands = (degree + 1) ** 2
    basis = sh_basis(gaussians.means - camera.center)[:, :bands]
    coefficients = torch.cat([gaussians.sh_dc, gaussians.sh_rest], 1)[:, :bands]
    colors = 0.5 + (basis[:, :, None] * coefficients).sum(1)
    colors = torch.where(colors >= LEAST_WITH_GRADIENT, colors, 0.0)
    return colors + (torch.clamp(colors, min=0) - colors).detach()  # clamps the values and lets the gradient pass


def sh_basis(directions: Tensor) -> Tensor:
    """The 16 orthonormal real harmonics of degrees 0 to 3 at directions (N, 3) of any length: (N, 16).

    By degree l and order m, (0, 0), (1, -1), (1, 0), (1, 1), (2, -2) ..., with the sign of Condon and Shortley, as in
    the reference's files. A direction of length 0 has degree 0 only.
    """
    length = directions.norm(dim=1, keepdim=True)
    x, y, z = (directions / torch.where(length > 0, length, 1.0)).unbind(1)
    basis = torch.stack([torch.ones_like(x) / (2 * torch.pi**0.5), *_degrees_1_and_2(x, y, z), *_degree_3(x, y, z)], -1)
    return torch.where((length > 0) | (torch.arange(16) == 0), basis, 0.0)


def _degrees_1_and_2(x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
    """Return the eight harmonics of degrees 1 and 2 at unit directions, each (N,).

    x, y, z: coordinates of the directions, (N,).
    """
    linear = (3 / (4 * torch.pi)) ** 0.5
    mixed, zonal = 0.5 * (15 / torch.pi) ** 0.5, 0.25 * (5 / torch.pi) ** 0.5
    return [
        -linear * y,
        linear * z,
        -linear * x,
        mixed * x * y,
        -mixed * y * z,
        zonal * (3 * z * z - 1),
        -mixed * x * z,
        mixed / 2 * (x * x - y * y),
    ]


def _degree_3(x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
    """Return the seven harmonics of degree 3 at unit directions, each (N,).

    x, y, z: coordinates of the directions, (N,).
    """
    outer, inner = 0.25 * (35 / (2 * torch.pi)) ** 0.5, 0.25 * (21 / (2 * torch.pi)) ** 0.5  # orders 3 and 1
    mixed, zonal = (105 / torch.pi) ** 0.5, 0.25 * (7 / torch.pi) ** 0.5
    return [
        -outer * y * (3 * x * x - y * y),
        0.5 * mixed * x * y * z,
        -inner * y * (5 * z * z - 1),
        zonal * (5 * z**3 - 3 * z),
        -inner * x * (5 * z * z - 1),
        0.25 * mixed * z * (x * x - y * y),
        -outer * x * (x * x - 3 * y * y),
    ]
