"""Real spherical harmonics of view directions, degrees 0 to 4, in the sign convention of the rasterizer."""

import torch
from torch import Tensor

# The factors of the basis, by degree.
C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = [1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396]
C3 = [
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
]
C4 = [
    2.5033429417967046,
    -1.7701307697799304,
    0.9461746957575601,
    -0.6690465435572892,
    0.10578554691520431,
    -0.6690465435572892,
    0.47308734787878004,
    -1.7701307697799304,
    0.6258357354491761,
]


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
        terms += [-C1 * y, C1 * z, -C1 * x]
    if deg >= 2:
        terms += [C2[0] * x * y, C2[1] * y * z, C2[2] * (2 * zz - xx - yy), C2[3] * x * z, C2[4] * (xx - yy)]
    if deg >= 3:
        terms += [
            C3[0] * y * (3 * xx - yy),
            C3[1] * x * y * z,
            C3[2] * y * (4 * zz - xx - yy),
            C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            C3[4] * x * (4 * zz - xx - yy),
            C3[5] * z * (xx - yy),
            C3[6] * x * (xx - 3 * yy),
        ]
    if deg >= 4:
        terms += [
            C4[0] * x * y * (xx - yy),
            C4[1] * y * z * (3 * xx - yy),
            C4[2] * x * y * (7 * zz - 1),
            C4[3] * y * z * (7 * zz - 3),
            C4[4] * (zz * (35 * zz - 30) + 3),
            C4[5] * x * z * (7 * zz - 3),
            C4[6] * (xx - yy) * (7 * zz - 1),
            C4[7] * x * z * (xx - 3 * yy),
            C4[8] * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
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
