"""Errors along needles, by their length: of the exponent, and of the gradient of the 2D covariance."""

import math

import torch
from diff_gaussian_rasterization import Gaussians, rasterize, reference
from diff_gaussian_rasterization.scene import scene_arguments
from torch import Tensor

from benchmarks.workloads import textbook

OPS = torch.ops.diff_gaussian_rasterization


def exponent_errors(parameters: dict[str, Tensor], camera) -> tuple[float, float]:
    """The largest error of log2 of alpha, of ours and of the textbook's formulas in float32, against the oracle.

    It is computed from the rendered transmittance of one needle at a time, so it is what a user sees.
    """
    wanted, *found = [_exponents(parameters, camera, f) for f in (reference.render, rasterize, textbook.render)]
    # Alpha must not be near the cut-off, nor so near 1 that 1 - T loses digits. At alpha 0.01, 1 - T rounds by 1e-5.
    seen = (wanted > math.log2(0.01)) & (wanted < math.log2(0.97))
    ours, theirs = (float((e - wanted)[seen].abs().nan_to_num(nan=math.inf, posinf=math.inf).max()) for e in found)
    return ours, theirs


def _exponents(parameters: dict[str, Tensor], camera, render) -> Tensor:
    """Render each needle alone; return log2 of its alpha, (n, H, W) float64, -inf where it is not blended."""
    rows = []
    for i in range(len(parameters["means"])):
        one = {name: t[i : i + 1] for name, t in parameters.items()}
        means, opacities = one.pop("means"), one.pop("opacities")
        wanted = {"want_transmittance": True} if render is rasterize else {}
        out = render(means, torch.zeros_like(means), opacities, camera, raw=True, **one, **wanted)
        rows.append(torch.log2(1 - out.transmittance[0].double()))
    return torch.stack(rows)


def gradient_errors(parameters: dict[str, Tensor], camera) -> tuple[float, float]:
    """The median over needles of |difference| / |reference| of the covariance's gradient, ours and the textbook's.

    Without the rounding of the inputs: the float32 splats that `project` returned count as exact, and the reference is
    autograd in float64 on the definition of the image, with their means and covariances.
    """
    height, width = camera.image_height, camera.image_width
    splats, depths, rects, counts, _ = OPS.project(*scene_arguments(Gaussians(**parameters), camera, raw=True))
    order = torch.argsort(torch.where(counts > 0, depths, math.inf), stable=True)[: int((counts > 0).sum())]
    l11, l12, l22 = splats[order, 2:5].double().unbind(1)
    xx, xy, yy = 1 / l11**2 + (l12 / (l11 * l22)) ** 2, -l12 / (l11 * l22**2), 1 / l22**2
    covariance = 0.5 / math.log(2) * torch.stack([xx, xy, yy], 1)
    wanted, weights = _definition(splats[order].double(), covariance, height, width)

    instances, ranges, *slots = OPS.bin(splats, depths, rects, counts, height, width, True)
    background = torch.zeros(3)
    _, left, _, last, layers = OPS.blend(splats, instances, ranges, background, height, width, False, True)
    kept = splats, counts, instances, ranges, *slots, last, layers, background, left
    rows, of_each = OPS.blend_rows(kept, weights.float(), None, None)
    moments = torch.zeros(len(splats), rows.shape[1], dtype=torch.float64)
    moments.index_add_(0, torch.arange(len(splats)).repeat_interleave(of_each), rows.double())
    quu, quv, qvv = moments[order, 3:6].unbind(1)
    uu, uv = quu * l11, quv * l11  # gradient of a symmetric matrix, 2 ln2^2 L^T W2 L; xy stands for two entries
    vu, vv = quu * l12 + quv * l22, quv * l12 + qvv * l22
    ours = 2 * math.log(2) ** 2 * torch.stack([l11 * uu, 2 * (l12 * uu + l22 * uv), l12 * vu + l22 * vv], 1)

    rounded = covariance.float()
    of_theirs, _ = _definition(splats[order].double(), rounded.double(), height, width, weights)
    theirs, _ = _definition(splats[order], rounded, height, width, weights)
    return _median_error(ours, wanted), _median_error(theirs, of_theirs)


def _definition(
    rows: Tensor, covariance: Tensor, height: int, width: int, weights: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return the gradient of a weighted sum of the image's values with respect to the covariances, and the weights.

    rows: splats in depth order; covariance: (n, 3) xx, xy, yy, inverted by the textbook formula in their dtype.
    weights: (3, H, W); by default random, and 0 near a cut-off.
    """
    leaf = covariance.clone().requires_grad_()
    a, b, c = leaf.unbind(1)
    det = a * c - b * b
    dx = torch.arange(width).to(rows) - rows[:, 0, None, None]
    dy = torch.arange(height).to(rows)[:, None] - rows[:, 1, None, None]
    conic = [(v / det)[:, None, None] for v in (c, -b, a)]
    power = -0.5 * (conic[0] * dx * dx + conic[2] * dy * dy) - conic[1] * dx * dy
    alpha = torch.exp2(rows[:, 5, None, None]) * torch.exp(power)
    reached = (alpha >= 1 / 255) & (power <= 0)
    after = torch.cumprod(1 - torch.where(reached, alpha.clamp(max=0.99), 0.0), 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    image = torch.einsum("nhw,nc->chw", torch.where(reached, alpha.clamp(max=0.99), 0.0) * before, rows[:, 6:9])
    if weights is None:
        near = ((alpha * 255 - 1).abs() < 1e-2) | (alpha > 0.98) | (after < 2e-4)
        generator = torch.Generator().manual_seed(9)
        weights = torch.randn(3, height, width, generator=generator, dtype=torch.float64) * ~near.any(0)
    (image * weights.to(image)).sum().backward()
    return leaf.grad, weights


def _median_error(got: Tensor, wanted: Tensor) -> float:
    wanted = wanted.double()
    size = wanted.norm(dim=1)
    counted = size > 1e-6 * size.max()
    errors = (got.double() - wanted).norm(dim=1)[counted] / size[counted]
    return float(errors.nan_to_num(nan=math.inf, posinf=math.inf).median())
