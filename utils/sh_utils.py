"""Real spherical harmonics of view directions, degrees 0 to 4, in the sign convention of the rasterizer."""

import torch
from torch import Tensor

C0 = 0.28209479177387814


def sh_basis(deg: int, dirs: Tensor) -> Tensor:
    """Basis values (..., (deg+1)^2) at unit vectors dirs (..., 3).

    Order l = 0..deg, m = -l..l, with the Condon-Shortley sign (-1)^m. The factors are the usual normalisation
    sqrt((2l+1)/(4 pi) (l-|m|)!/(l+|m|)!), times sqrt(2) for m != 0, times the polynomial's own factor.
    """
    if not 0 <= deg <= 4:
        raise ValueError(f"degree must be 0 to 4, got {deg}")
    x, y, z = dirs.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    terms = [torch.full_like(x, C0)]
    if deg >= 1:
        terms += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if deg >= 2:
        terms += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if deg >= 3:
        terms += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    if deg >= 4:
        terms += [
            2.5033429417967046 * x * y * (xx - yy),
            -1.7701307697799304 * y * z * (3 * xx - yy),
            0.9461746957575601 * x * y * (7 * zz - 1),
            -0.6690465435572892 * y * z * (7 * zz - 3),
            0.10578554691520431 * (zz * (35 * zz - 30) + 3),
            -0.6690465435572892 * x * z * (7 * zz - 3),
            0.47308734787878004 * (xx - yy) * (7 * zz - 1),
            -1.7701307697799304 * x * z * (xx - 3 * yy),
            0.6258357354491761 * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
        ]
    return torch.stack(terms, dim=-1)


def eval_sh(deg: int, sh: Tensor, dirs: Tensor) -> Tensor:
    """Sum of coefficients sh (..., C, K), K >= (deg+1)^2, times the basis at unit vectors dirs (..., 3): (..., C)."""
    basis = sh_basis(deg, dirs)
    return (sh[..., : basis.shape[-1]] * basis[..., None, :]).sum(-1)


def RGB2SH(rgb: Tensor) -> Tensor:
    """Coefficient of degree 0 that gives the colour rgb in [0, 1]."""
    return (rgb - 0.5) / C0


def SH2RGB(sh: Tensor) -> Tensor:
    """Colour of a coefficient of degree 0."""
    return sh * C0 + 0.5
