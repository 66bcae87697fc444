"""3D Gaussian Splatting as the papers write it, in the dtype of its inputs, to compare with the kernels' arithmetic.

Kerbl et al. 2023 (eq. 3 to 6) and Zwicker et al. 2001 (section 4.4) are followed literally: the 3D covariance as a
product, its projection, the conic as the inverse of a 2x2 matrix by xx yy - xy xy, the exponent as a quadratic form in
image coordinates, transmittance as a running product. Autograd differentiates each. There are no tiles and no cut at 3
sigma: only the arithmetic differs from the kernels'. Memory: N x H x W x some 100 bytes.
"""

from typing import NamedTuple

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, Gaussians
from torch import Tensor

from utils.sh_utils import eval_sh


class Rendered(NamedTuple):
    """Planes, as the rasterizer names them."""

    color: Tensor  # (3, H, W)
    inverse_depth: Tensor  # (1, H, W)
    transmittance: Tensor  # (1, H, W)


class _Splats(NamedTuple):
    """The Gaussians in front of the camera, nearest first."""

    mean: Tensor  # (M, 2) px
    covariance: tuple[Tensor, Tensor, Tensor]  # xx, xy, yy (M,), px^2, dilated
    determinant: Tensor  # (M,) of that covariance
    opacity: Tensor  # (M,)
    color: Tensor  # (M, 3)
    depth: Tensor  # (M,)


def render(
    means: Tensor,
    means2d: Tensor,
    opacities: Tensor,
    settings: GaussianRasterizationSettings,
    *,
    raw: bool = True,
    **others: Tensor | None,
) -> Rendered:
    """Renders Gaussians; same arguments as `rasterize`, all in one dtype."""
    gaussians = Gaussians(means, opacities.reshape(-1), **others)
    if raw:
        scales, rotations = gaussians.scales, gaussians.rotations
        gaussians = gaussians._replace(
            opacities=torch.sigmoid(gaussians.opacities),
            scales=None if scales is None else torch.exp(scales),
            rotations=None if rotations is None else rotations / rotations.norm(dim=1, keepdim=True),
        )
    names = ("viewmatrix", "projmatrix", "campos", "bg")
    settings = settings._replace(**{name: getattr(settings, name).to(means.dtype) for name in names})
    return _blend(_project(gaussians, means2d, settings), settings)


def _project(gaussians: Gaussians, means2d: Tensor, settings: GaussianRasterizationSettings) -> _Splats:
    means, s = gaussians.means, settings
    covariance = make_covariances(gaussians, s.scale_modifier)
    ones = torch.ones_like(means[:, :1])
    t = (torch.cat([means, ones], 1) @ s.viewmatrix)[:, :3]
    clip = torch.cat([means, ones], 1) @ s.projmatrix
    front = torch.nonzero(t[:, 2] > 0.2)[:, 0]
    front = front[torch.argsort(t[front, 2], stable=True)]
    t, clip, covariance, opacity = t[front], clip[front], covariance[front], gaussians.opacities[front]
    size = torch.tensor([s.image_width, s.image_height], dtype=means.dtype)
    mean = ((clip[:, :2] / clip[:, 3:] + 1) * size - 1) / 2 + means2d[front, :2] * size / 2

    JW, z = _world_to_image(t, size, s)
    projected = JW @ covariance @ JW.transpose(1, 2)
    xx, xy, yy = projected[:, 0, 0], projected[:, 0, 1], projected[:, 1, 1]
    undilated = xx * yy - xy * xy
    xx, yy = xx + 0.3, yy + 0.3
    determinant = xx * yy - xy * xy
    if s.antialiasing:
        opacity = opacity * torch.sqrt(torch.clamp(undilated / determinant, min=2.5e-5))

    colors = gaussians.colors
    if colors is None:
        v = means - s.campos
        sh = torch.cat([gaussians.sh_dc, gaussians.sh_rest], 1)[:, : (s.sh_degree + 1) ** 2].transpose(1, 2)
        colors = torch.clamp(0.5 + eval_sh(s.sh_degree, sh, v / v.norm(dim=1, keepdim=True)), min=0)
    return _Splats(mean, (xx, xy, yy), determinant, opacity, colors[front], z)


def _world_to_image(t: Tensor, size: Tensor, settings: GaussianRasterizationSettings) -> tuple[Tensor, Tensor]:
    """J W (M, 2, 3) at view-space means t (M, 3), and their z (M,)."""
    dtype = t.dtype
    tan = torch.tensor([settings.tanfovx, settings.tanfovy], dtype=dtype)
    focal = size / (2 * tan)
    # The principal point, from the matrices as float32 has them.
    shift = (torch.linalg.inv(settings.viewmatrix.double()) @ settings.projmatrix.double())[2, :2].to(dtype)
    ray = torch.minimum(torch.maximum(t[:, :2] / t[:, 2:], (-1.3 - shift) * tan), (1.3 - shift) * tan)
    x, y, z = (*(ray * t[:, 2:]).unbind(1), t[:, 2])
    zero = torch.zeros_like(z)
    rows = [focal[0] / z, zero, -focal[0] * x / (z * z), zero, focal[1] / z, -focal[1] * y / (z * z)]
    return torch.stack(rows, -1).reshape(-1, 2, 3) @ settings.viewmatrix[:3, :3].T, z


def _blend(splats: _Splats, settings: GaussianRasterizationSettings) -> Rendered:
    height, width, dtype = settings.image_height, settings.image_width, splats.mean.dtype
    dx = torch.arange(width, dtype=dtype) - splats.mean[:, 0, None, None]
    dy = torch.arange(height, dtype=dtype)[:, None] - splats.mean[:, 1, None, None]
    xx, xy, yy = splats.covariance
    conic_xx, conic_xy, conic_yy = ((v / splats.determinant)[:, None, None] for v in (yy, -xy, xx))
    power = -0.5 * (conic_xx * dx * dx + conic_yy * dy * dy) - conic_xy * dx * dy
    alpha = splats.opacity[:, None, None] * torch.exp(power)
    reached = (power <= 0) & (alpha >= 1 / 255)
    alpha = alpha + (torch.clamp(alpha, max=0.99) - alpha).detach()  # the gradient passes the cap
    alpha = torch.where(reached, alpha, 0.0)
    alpha = torch.where(torch.cumprod(1 - alpha, 0) >= 1e-4, alpha, 0.0)
    after = torch.cumprod(1 - alpha, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    last = after[-1] if len(after) else torch.ones(height, width, dtype=dtype)
    weight = alpha * before
    color = torch.einsum("nhw,nc->chw", weight, splats.color) + last * settings.bg[:, None, None]
    return Rendered(color, (weight / splats.depth[:, None, None]).sum(0, keepdim=True), last[None])


def make_covariances(gaussians: Gaussians, scale_modifier: float) -> Tensor:
    """R S S^T R^T, or the given covariances unpacked: (N, 3, 3)."""
    if gaussians.cov3d is not None:
        return gaussians.cov3d[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    w, x, y, z = gaussians.rotations.unbind(1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    rs = torch.stack(rows, -1).reshape(-1, 3, 3) * (gaussians.scales * scale_modifier)[:, None, :]
    return rs @ rs.transpose(1, 2)
