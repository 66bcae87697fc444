"""The oracle: 3D Gaussian Splatting in plain float64 PyTorch, without tiles; autograd differentiates it. Shares no code
with csrc and decides in disputes. Textbook formulas but for the 2D covariance, whose a c - b b would leave float64 some
four digits on needles a million pixels long: its factor comes from LAPACK's QR, which squares nothing. (Given
covariances are factored as they are.) Memory: N x (rows at once) x W x some 100 bytes."""

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

if TYPE_CHECKING:
    from diff_gaussian_rasterization import GaussianRasterizationSettings


class Rendered(NamedTuple):
    """What `render` returns."""

    color: Tensor  # (3, H, W)
    radii: Tensor  # (N,) int32
    inverse_depth: Tensor  # (1, H, W)
    transmittance: Tensor  # (1, H, W)
    near_cut: Tensor  # (H, W) bool: within `cut` (relative) of a cut-off or a depth tie, where rounding may decide


def render(
    means: Tensor,
    means2d: Tensor,
    opacities: Tensor,
    settings: "GaussianRasterizationSettings",
    *,
    scales: Tensor | None = None,
    rotations: Tensor | None = None,
    cov3d: Tensor | None = None,
    sh_dc: Tensor | None = None,
    sh_rest: Tensor | None = None,
    colors: Tensor | None = None,
    raw: bool = False,
    rows_at_once: int = 32,
    cut: float = 1e-4,
) -> Rendered:
    """The definition of `rasterize`; same arguments, any float dtype, computed in float64; all must be finite."""
    s = settings
    width, height = s.image_width, s.image_height
    view, full, center, bg = (t.double() for t in (s.viewmatrix, s.projmatrix, s.campos, s.bg))
    means, opacity = means.double(), opacities.double().reshape(-1)
    if raw:
        opacity, scales, rotations = torch.sigmoid(opacity), scales.double().exp(), _unit(rotations.double())

    ones = torch.ones_like(means[:, :1])
    t = (torch.cat([means, ones], 1) @ view)[:, :3]
    clip = torch.cat([means, ones], 1) @ full
    front = t[:, 2] > 0.2
    z = torch.where(front, t[:, 2], 1.0)
    ndc = clip[:, :2] / torch.where(front, clip[:, 3], 1.0)[:, None]
    size = torch.tensor([width, height], dtype=torch.float64)
    mean2d = ((ndc + 1) * size - 1) / 2 + means2d.double()[:, :2] * size / 2

    projection = torch.linalg.inv(view) @ full
    tan = torch.tensor([s.tanfovx, s.tanfovy], dtype=torch.float64)
    focal, shift = size / (2 * tan), projection[2, :2]
    ray = t[:, :2] / z[:, None]
    ray = torch.minimum(torch.maximum(ray, (-1.3 - shift) * tan), (1.3 - shift) * tan)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [focal[0] / z, zero, -focal[0] * ray[:, 0] / z, zero, focal[1] / z, -focal[1] * ray[:, 1] / z], -1
    )
    p = jacobian.reshape(-1, 2, 3) @ view[:3, :3].T
    if cov3d is not None:
        factor, det0 = _factor_of_covariance(p @ _unpack(cov3d.double()) @ p.transpose(1, 2))
    else:
        factor, det0 = _factor(p @ _axes(scales.double() * s.scale_modifier, rotations.double()))
    r11, r12, r22 = factor
    a, b, c = r11 * r11, r11 * r12, r12 * r12 + r22 * r22
    if s.antialiasing:
        # det0 / det, det = det0 + 0.3 (trace - 0.3); det of splats as large as 1e3 px has nothing of the 0.3 left.
        lost = 0.3 * (a + c - 0.3) / torch.clamp(det0, min=1e-8)  # below, the ratio is under its floor
        opacity = opacity * torch.sqrt(torch.clamp(1 / (1 + lost), min=2.5e-5))

    half = ((a - c) / 2) ** 2 + b * b
    radius = torch.ceil(3 * torch.sqrt((a + c) / 2 + torch.sqrt(torch.clamp(half, min=0.1))))
    tiles = torch.ceil(size / 16)
    low = torch.clamp(torch.trunc((mean2d - radius[:, None]) / 16), min=0)
    high = torch.trunc((mean2d + radius[:, None] + 15) / 16)
    on_image = (torch.minimum(high, tiles) > torch.minimum(low, tiles)).all(1)
    radii = torch.where(front & on_image, radius, 0.0).to(torch.int32)

    if colors is None:
        k = (s.sh_degree + 1) ** 2
        basis = _sh_basis(means - center)[:, :k]
        sh = torch.cat([sh_dc, sh_rest], 1).double()[:, :k]
        colors = 0.5 + (basis[:, :, None] * sh).sum(1)
        colors = torch.where(colors >= -1e-6, colors, 0.0)  # with a gradient at 0, where black points of a cloud start
        colors = colors + (torch.clamp(colors, min=0) - colors).detach()
    colors = colors.double()

    order = torch.argsort(torch.where(front, t[:, 2], torch.inf), stable=True)[: int(front.sum())]
    gaps = t[order, 2].diff()
    tie = torch.zeros(len(order), dtype=torch.bool)
    tie[1:] = gaps < 0.01 * cut * t[order[1:], 2]
    x = torch.arange(width, dtype=torch.float64)
    parts = []
    for first in range(0, height, rows_at_once):
        y = torch.arange(first, min(first + rows_at_once, height), dtype=torch.float64)
        dx = x[None, None, :] - mean2d[order, 0, None, None]
        dy = y[None, :, None] - mean2d[order, 1, None, None]
        f11, f12, f22 = (f[order, None, None] for f in factor)
        u = dx / f11  # R^T (u, v) = (dx, dy)
        v = (dy - f12 * u) / f22
        alpha = opacity[order, None, None] * torch.exp(-0.5 * (u * u + v * v))
        near = (alpha * 255 - 1).abs() < cut
        reached = alpha >= 1 / 255
        alpha = alpha + (torch.clamp(alpha, max=0.99) - alpha).detach()  # the gradient passes the cap
        alpha = torch.where(reached, alpha, 0.0)
        after = torch.cumprod(1 - alpha, 0)
        blended = after >= 1e-4
        near = (near | ((after * 1e4 - 1).abs() < cut) | (tie[:, None, None] & reached)).any(0)
        alpha = torch.where(blended, alpha, 0.0)
        after = torch.cumprod(1 - alpha, 0)
        last = after[-1] if len(order) else torch.ones(len(y), width, dtype=torch.float64)
        before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
        weight = alpha * before
        color = torch.einsum("nhw,nc->chw", weight, colors[order]) + last * bg[:, None, None]
        depth = (weight / z[order, None, None]).sum(0)
        parts.append((color, depth, last, near))
    color, depth, last, near = (torch.cat(items, -2) for items in zip(*parts, strict=True))
    return Rendered(color, radii, depth[None], last[None], near)


def _unit(q: Tensor) -> Tensor:
    norm = q.norm(dim=1, keepdim=True)
    zero = norm < 1e-30  # counts as the identity
    identity = torch.tensor([1.0, 0, 0, 0], dtype=q.dtype)
    return torch.where(zero, identity, q / torch.where(zero, 1.0, norm))


def _axes(scales: Tensor, q: Tensor) -> Tensor:
    w, x, y, z = q.unbind(1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(rows, -1).reshape(-1, 3, 3) * scales[:, None, :]


# The upper triangular R with R^T R = M M^T + 0.3, as r11, r12, r22, and det M M^T.


def _factor(m: Tensor) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    dilation = 0.3**0.5 * torch.eye(2, dtype=m.dtype).expand(len(m), 2, 2)
    r = torch.linalg.qr(torch.cat([m, dilation], 2).transpose(1, 2)).R
    det0 = torch.linalg.cross(m[:, 0], m[:, 1]).square().sum(1)
    return (r[:, 0, 0], r[:, 0, 1], r[:, 1, 1]), det0


def _factor_of_covariance(cov: Tensor) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    a, b, c = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    det = (a + 0.3) * (c + 0.3) - b * b
    r11 = torch.sqrt(a + 0.3)
    return (r11, b / r11, torch.sqrt(det) / r11), a * c - b * b


def _unpack(c: Tensor) -> Tensor:
    return c[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def _sh_basis(v: Tensor) -> Tensor:
    norm = v.norm(dim=1, keepdim=True)
    x, y, z = (v / torch.where(norm > 0, norm, 1.0)).unbind(1)
    pi = torch.pi
    # The orthonormal real harmonics from their definition, with the Condon-Shortley sign of the files.
    one = torch.ones_like(x) / (2 * pi**0.5)
    first = (3 / (4 * pi)) ** 0.5
    second, third = 0.5 * (15 / pi) ** 0.5, 0.25 * (35 / (2 * pi)) ** 0.5
    basis = [one, -first * y, first * z, -first * x]
    basis += [second * x * y, -second * y * z, 0.25 * (5 / pi) ** 0.5 * (3 * z * z - 1), -second * x * z]
    basis += [second / 2 * (x * x - y * y)]
    fifth = 0.25 * (21 / (2 * pi)) ** 0.5
    basis += [-third * y * (3 * x * x - y * y), 0.5 * (105 / pi) ** 0.5 * x * y * z, -fifth * y * (5 * z * z - 1)]
    basis += [0.25 * (7 / pi) ** 0.5 * (5 * z**3 - 3 * z), -fifth * x * (5 * z * z - 1)]
    basis += [0.25 * (105 / pi) ** 0.5 * z * (x * x - y * y), -third * x * (x * x - 3 * y * y)]
    # Seen from nowhere, degree 0 alone is left.
    return torch.where((norm > 0) | (torch.arange(16) == 0), torch.stack(basis, -1), 0.0)
