"""Lenses in float64: where one shows points, and which ray of it meets a pixel."""

import torch
from torch import Tensor

from diff_gaussian_rasterization.lens import Lens

_STEPS = 60  # of Newton's method: it needs under ten, but where the distortion nearly turns back
_SOLVED = 1e-9  # of the chart's numbers, about 1e-6 px


def pixels(lens: Lens, points: Tensor) -> Tensor:
    """Pixels (..., 2) of points (..., 3) of the view, by the formulas of COLMAP's models."""
    x, y, z = points.unbind(-1)
    if lens.chart == "equirectangular":
        a, b = torch.atan2(x, z), torch.atan2(y, torch.hypot(x, z))
    else:
        square = x * x + y * y
        r = torch.sqrt(torch.where(square > 0, square, 1.0))
        angular = torch.where(square > 0, torch.atan2(r, z) / r, 1 / z)
        stretch = 1 / z if lens.chart == "perspective" else angular
        a, b = x * stretch, y * stretch
    return pixels_of(lens, torch.stack([a, b], -1))


def pixels_of(lens: Lens, numbers: Tensor) -> Tensor:
    """Pixels (..., 2) of numbers (..., 2) of the lens's chart."""
    found = _distort(lens, numbers)
    return found * torch.tensor(lens.focal, dtype=numbers.dtype) + torch.tensor(lens.center, dtype=numbers.dtype)


def jacobians(lens: Lens, points: Tensor) -> Tensor:
    """Derivatives of `pixels` by the points (N, 3): (N, 2, 3)."""
    return torch.func.vmap(torch.func.jacrev(lambda point: pixels(lens, point)))(points)


def rays(lens: Lens, width: int, height: int) -> Tensor:
    """Directions (H, W, 3) of the pixels, of any length; 0 where the lens shows none."""
    y, x = (t.double() for t in torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij"))
    found = numbers_of(lens, torch.stack([x, y], -1).reshape(-1, 2), width, height)
    solved = found.isfinite().all(1)
    return torch.where(solved[:, None], _to_directions(lens, found), 0.0).reshape(height, width, 3)


def numbers_of(lens: Lens, places: Tensor, width: int, height: int) -> Tensor:
    """Numbers (N, 2) of the chart, at which the lens shows pixels (N, 2) float64; NaN where it shows nothing.

    Newton's method, from the pixel's numbers as if there were no distortion.
    """
    focal, center = (torch.tensor(t, dtype=torch.float64) for t in (lens.focal, lens.center))
    wanted = (places - center) / focal
    found, of_one = wanted.clone(), torch.func.jacrev(lambda numbers: _distort(lens, numbers))
    for _ in range(_STEPS):
        off = _distort(lens, found) - wanted
        (xx, xy), (yx, yy) = torch.func.vmap(of_one)(found).permute(1, 2, 0)
        step = torch.stack([yy * off[:, 0] - xy * off[:, 1], xx * off[:, 1] - yx * off[:, 0]], 1)
        found = found - step / (xx * yy - xy * yx)[:, None]
        if (step.abs().nan_to_num(0) < 1e-16).all():
            break
    solved = (_distort(lens, found) - wanted).abs().amax(1) < _SOLVED
    _, limit, _, *_ = lens.numbers(width, height)
    solved &= found.square().sum(1) <= limit
    return torch.where(solved[:, None], found, torch.nan)


def _distort(lens: Lens, numbers: Tensor) -> Tensor:
    """Distort numbers (..., 2) of the chart, by Brown 1966 and Weng et al. 1992."""
    a, b = numbers.unbind(-1)
    q, (p1, p2) = a * a + b * b, lens.tangential
    over, under = (1 + sum(c * q ** (k + 1) for k, c in enumerate(terms)) for terms in (lens.radial, lens.divisor))
    across = a * over / under + 2 * p1 * a * b + p2 * (q + 2 * a * a) + lens.prism[0] * q
    down = b * over / under + 2 * p2 * a * b + p1 * (q + 2 * b * b) + lens.prism[1] * q
    return torch.stack([across, down], -1)


def _to_directions(lens: Lens, numbers: Tensor) -> Tensor:
    """Return the directions (N, 3) of a chart's numbers (N, 2); 0 for numbers without a direction."""
    a, b = numbers.unbind(1)
    if lens.chart == "perspective":
        return torch.stack([a, b, torch.ones_like(a)], 1)
    if lens.chart == "equirectangular":
        found, valid = (
            [a.sin() * b.cos(), b.sin(), a.cos() * b.cos()],
            (a.abs() <= torch.pi) & (b.abs() <= torch.pi / 2),
        )
    else:
        theta = torch.hypot(a, b)
        sinc = torch.sinc(theta / torch.pi)
        found, valid = [a * sinc, b * sinc, theta.cos()], theta < torch.pi
    return torch.where(valid[:, None], torch.stack(found, 1), 0.0)
