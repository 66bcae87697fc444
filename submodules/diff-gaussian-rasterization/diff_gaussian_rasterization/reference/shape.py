"""The shape of a Gaussian: its covariance in the world, and its ellipse on the image.

The textbook's determinant, xx yy - xy xy, would leave float64 some four digits on needles a million pixels long.
Ellipses are therefore kept as a triangular factor, from a determinant that is a sum of squares. QR would compute the
same factor, but its derivative rounds next to the dilation: scales below 1e-13 would lose their gradients. Covariances
given by the caller are squares already and are factored as they are.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from diff_gaussian_rasterization.gaussians import Gaussians
from diff_gaussian_rasterization.reference.camera import Camera, Points, world_to_image

TILE = 16  # px; a radius counts only where its square touches a tile of the image


class Ellipses(NamedTuple):
    """Dilated covariances on the image, as their factor: covariance = R^T R with R upper triangular."""

    r11: Tensor  # (N,) px, as are the next two
    r12: Tensor
    r22: Tensor
    undilated: Tensor  # (N,) px^4: determinant before the dilation
    dilation: float  # px^2

    def covariance(self) -> tuple[Tensor, Tensor, Tensor]:
        """Entries xx, xy and yy, px^2."""
        return self.r11 * self.r11, self.r11 * self.r12, self.r12 * self.r12 + self.r22 * self.r22


def activated(raw: Gaussians) -> Gaussians:
    """Applies the activations of Kerbl et al. 2023, section 5.1: sigmoid to opacities, exp to scales.

    Quaternions are normalised; a zero one means the identity.
    """
    return raw._replace(
        opacities=torch.sigmoid(raw.opacities),
        scales=None if raw.scales is None else raw.scales.exp(),
        rotations=None if raw.rotations is None else _normalise(raw.rotations),
    )


def project_shapes(gaussians: Gaussians, points: Points, camera: Camera, scale_modifier: float) -> Ellipses:
    """J W Sigma W^T J^T (Kerbl et al. 2023, eq. 5), plus the dilation."""
    return ellipses_of(world_to_image(points, camera), *in_space(gaussians, scale_modifier), camera.dilation)


def in_space(gaussians: Gaussians, scale_modifier: float) -> tuple[Tensor | None, Tensor | None]:
    """R S and None, where Sigma = R S S^T R^T (Kerbl et al. 2023, eq. 6), or None and Sigma: both (N, 3, 3)."""
    if gaussians.cov3d is not None:
        return None, gaussians.cov3d[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    S = gaussians.scales * scale_modifier  # the diagonal
    return rotation_matrices(gaussians.rotations) * S[:, None, :], None


def ellipses_of(JW: Tensor, RS: Tensor | None, Sigma: Tensor | None, dilation: float) -> Ellipses:
    """The dilated ellipses of Gaussians of `in_space` under linear maps JW (N, 2, 3)."""
    if RS is None:
        return _factor_of_covariance(JW @ Sigma @ JW.transpose(1, 2), dilation)
    return _factor_half(JW @ RS, dilation)


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """R (N, 3, 3) of quaternions (N, 4), w x y z, of unit length."""
    w, x, y, z = quaternions.unbind(1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def compensation(ellipses: Ellipses) -> Tensor:
    """The antialiasing factor of opacities (N,): sqrt(det / dilated det), as in Yu et al. 2024 (Mip-Splatting).

    The ratio is 1 / (1 + grown / det), where grown = dilated det - det = h (trace - h) with the dilated trace and the
    dilation h.
    Subtracting the determinants would lose every digit of `grown` on splats of 1,000 px.
    """
    xx, _, yy = ellipses.covariance()
    grown = ellipses.dilation * (xx + yy - ellipses.dilation)
    ratio = 1 / (1 + grown / torch.clamp(ellipses.undilated, min=1e-8))  # a smaller det gives the floor below anyway
    return torch.sqrt(torch.clamp(ratio, min=2.5e-5))


def radii(points: Points, ellipses: Ellipses, camera: Camera) -> Tensor:
    """Three standard deviations of the long axis (Kerbl et al. 2023, section 6), rounded up: (N,) int32 px.

    0 for Gaussians that are not in front, or whose square of that radius touches no tile of the image.
    """
    xx, xy, yy = ellipses.covariance()
    discriminant = torch.clamp(((xx - yy) / 2) ** 2 + xy * xy, min=0.1)
    radius = torch.ceil(3 * torch.sqrt((xx + yy) / 2 + torch.sqrt(discriminant)))
    tiles = torch.ceil(camera.size / TILE)
    first = torch.clamp(torch.trunc((points.pixel - radius[:, None]) / TILE), min=0)
    end = torch.trunc((points.pixel + radius[:, None] + (TILE - 1)) / TILE)
    on_image = (torch.minimum(end, tiles) > torch.minimum(first, tiles)).all(1)
    return torch.where(points.in_front & on_image, radius, 0.0).to(torch.int32)


def _normalise(quaternions: Tensor) -> Tensor:
    length = quaternions.norm(dim=1, keepdim=True)
    is_zero = length < 1e-30
    identity = torch.tensor([1.0, 0, 0, 0], dtype=quaternions.dtype)
    return torch.where(is_zero, identity, quaternions / torch.where(is_zero, 1.0, length))


def _factor_half(half: Tensor, dilation: float) -> Ellipses:
    """The ellipses of half half^T + dilation I, where half (N, 2, 3) is J W R S."""
    across, down = half.unbind(1)
    xx, xy, yy = (across * across).sum(1), (across * down).sum(1), (down * down).sum(1)
    undilated = torch.linalg.cross(across, down).square().sum(1)  # Cauchy-Binet: nothing cancels
    dilated = undilated + dilation * (xx + yy) + dilation**2
    r11 = torch.sqrt(xx + dilation)
    return Ellipses(r11, xy / r11, torch.sqrt(dilated) / r11, undilated, dilation)


def _factor_of_covariance(covariance: Tensor, dilation: float) -> Ellipses:
    """The ellipses of covariances (N, 2, 2) + dilation I, by Cholesky's formulas."""
    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    dilated = (xx + dilation) * (yy + dilation) - xy * xy
    r11 = torch.sqrt(xx + dilation)
    return Ellipses(r11, xy / r11, torch.sqrt(dilated) / r11, xx * yy - xy * xy, dilation)
