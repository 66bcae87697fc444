"""Real spherical harmonics of any degree and number of channels, by PyTorch."""

import math

import torch
from torch import Tensor


def sh_basis(degree: int, directions: Tensor) -> Tensor:
    """Return the functions of all bands up to a degree, (N, (degree + 1)^2), at unit vectors; differentiable.

    Orders of a band go from -l to l, with the Condon-Shortley phase, as 3DGS has them. The method is that of
    recurrences of the associated Legendre functions without their powers of the sine (Sloan 2008, Stupid Spherical
    Harmonics Tricks, appendix A1).

    directions: (N, 3), unit vectors.
    """
    x, y, z = directions.unbind(-1)
    real, imaginary = [torch.ones_like(x)], [torch.zeros_like(x)]  # of (x + i y)^m
    for _ in range(degree):
        a, b = real[-1], imaginary[-1]
        real.append(x * a - y * b)
        imaginary.append(x * b + y * a)
    bands: dict[tuple[int, int], Tensor] = {}
    for m in range(degree + 1):
        before, now = None, torch.full_like(x, (-1) ** m * math.prod(range(1, 2 * m, 2)))
        for l in range(m, degree + 1):  # noqa: E741  (the field's letter)
            if l > m:
                longer = (2 * l - 1) * z * now
                before, now = now, (longer if before is None else longer - (l + m - 1) * before) / (l - m)
            size = math.sqrt((2 * l + 1) / (4 * math.pi) * math.factorial(l - m) / math.factorial(l + m))
            for order, part in ((m, real), (-m, imaginary))[: 2 if m else 1]:
                bands[l, order] = (size * math.sqrt(2) if m else size) * part[m] * now
    return torch.stack([bands[k, m] for k in range(degree + 1) for m in range(-k, k + 1)], -1)


def sh_values(degree: int, coefficients: Tensor, directions: Tensor) -> Tensor:
    """Return the values of spherical harmonics in directions, (N, D).

    degree: highest degree that counts.
    coefficients: (N, K, D), K >= (degree + 1)^2 of them for each of D channels; those of higher degrees are not read.
    directions: (N, 3), of any length.
    """
    basis = sh_basis(degree, torch.nn.functional.normalize(directions, dim=-1))
    return torch.einsum("nk,nkd->nd", basis, coefficients[:, : basis.shape[1]])
