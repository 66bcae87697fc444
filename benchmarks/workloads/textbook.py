"""3D Gaussian Splatting as the papers write it, in the dtype of its inputs: what the kernels' arithmetic is judged by.

Zwicker et al. 2001 (EWA splatting, eq. 29 and 31) and Kerbl et al. 2023 (eq. 4 to 6) read off literally: the 3D
covariance as a product, its projection, the conic as the inverse of a 2x2 matrix by a c - b b, the exponent as a
quadratic form in image coordinates, transmittance as a running product; autograd differentiates each. No tiles, no
3-sigma cut: only arithmetic differs from the kernels. Memory: N x H x W x some 100 bytes.
"""

from typing import NamedTuple

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings
from torch import Tensor

from utils.sh_utils import eval_sh


class Rendered(NamedTuple):
    """Planes, as the rasterizer names them."""

    color: Tensor  # (3, H, W)
    inverse_depth: Tensor  # (1, H, W)
    transmittance: Tensor  # (1, H, W)


def render(
    means: Tensor,
    means2d: Tensor,
    opacities: Tensor,
    settings: GaussianRasterizationSettings,
    *,
    scales: Tensor | None = None,
    rotations: Tensor | None = None,
    cov3d: Tensor | None = None,
    sh_dc: Tensor | None = None,
    sh_rest: Tensor | None = None,
    colors: Tensor | None = None,
    raw: bool = True,
) -> Rendered:
    """The same arguments as `rasterize`, all in one dtype."""
    s, dtype = settings, means.dtype
    view, full, center, background = (t.to(dtype) for t in (s.viewmatrix, s.projmatrix, s.campos, s.bg))
    opacity = opacities.reshape(-1)
    if raw:
        opacity, scales = torch.sigmoid(opacity), torch.exp(scales)
        rotations = rotations / rotations.norm(dim=1, keepdim=True)
    covariance = _unpacked(cov3d) if cov3d is not None else _covariance(scales * s.scale_modifier, rotations)

    ones = torch.ones_like(means[:, :1])
    t = (torch.cat([means, ones], 1) @ view)[:, :3]
    clip = torch.cat([means, ones], 1) @ full
    front = torch.nonzero(t[:, 2] > 0.2)[:, 0]
    front = front[torch.argsort(t[front, 2], stable=True)]
    t, clip, covariance, opacity = t[front], clip[front], covariance[front], opacity[front]
    size = torch.tensor([s.image_width, s.image_height], dtype=dtype)
    mean = ((clip[:, :2] / clip[:, 3:] + 1) * size - 1) / 2 + means2d[front, :2] * size / 2

    tan = torch.tensor([s.tanfovx, s.tanfovy], dtype=dtype)
    focal = size / (2 * tan)
    shift = (torch.linalg.inv(view.double()) @ full.double())[2, :2].to(dtype)
    ray = torch.minimum(torch.maximum(t[:, :2] / t[:, 2:], (-1.3 - shift) * tan), (1.3 - shift) * tan)
    x, y, z = (*(ray * t[:, 2:]).unbind(1), t[:, 2])
    zero = torch.zeros_like(z)
    rows = [focal[0] / z, zero, -focal[0] * x / (z * z), zero, focal[1] / z, -focal[1] * y / (z * z)]
    jw = torch.stack(rows, -1).reshape(-1, 2, 3) @ view[:3, :3].T
    cov = jw @ covariance @ jw.transpose(1, 2)
    a, b, c = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    det0 = a * c - b * b
    a, c = a + 0.3, c + 0.3
    det = a * c - b * b
    if s.antialiasing:
        opacity = opacity * torch.sqrt(torch.clamp(det0 / det, min=2.5e-5))

    if colors is None:
        k = (s.sh_degree + 1) ** 2
        v = means - center
        sh = torch.cat([sh_dc, sh_rest], 1)[:, :k].transpose(1, 2)
        colors = torch.clamp(0.5 + eval_sh(s.sh_degree, sh, v / v.norm(dim=1, keepdim=True)), min=0)
    colors = colors[front]

    dx = torch.arange(s.image_width, dtype=dtype) - mean[:, 0, None, None]
    dy = torch.arange(s.image_height, dtype=dtype)[:, None] - mean[:, 1, None, None]
    conic_a, conic_b, conic_c = ((v / det)[:, None, None] for v in (c, -b, a))
    power = -0.5 * (conic_a * dx * dx + conic_c * dy * dy) - conic_b * dx * dy
    alpha = opacity[:, None, None] * torch.exp(power)
    reached = (power <= 0) & (alpha >= 1 / 255)
    alpha = alpha + (torch.clamp(alpha, max=0.99) - alpha).detach()  # the gradient passes the cap
    alpha = torch.where(reached, alpha, 0.0)
    alpha = torch.where(torch.cumprod(1 - alpha, 0) >= 1e-4, alpha, 0.0)
    after = torch.cumprod(1 - alpha, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    last = after[-1] if len(front) else torch.ones(s.image_height, s.image_width, dtype=dtype)
    weight = alpha * before
    color = torch.einsum("nhw,nc->chw", weight, colors) + last * background[:, None, None]
    return Rendered(color, (weight / z[:, None, None]).sum(0, keepdim=True), last[None])


def _covariance(scales: Tensor, q: Tensor) -> Tensor:
    w, x, y, z = q.unbind(1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    rs = torch.stack(rows, -1).reshape(-1, 3, 3) * scales[:, None, :]
    return rs @ rs.transpose(1, 2)


def _unpacked(c: Tensor) -> Tensor:
    return c[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
