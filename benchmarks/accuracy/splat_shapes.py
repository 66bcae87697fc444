"""Stiffness of Gaussians, as cameras see them: five numbers for each, and the distribution of these numbers.

A splat is a Gaussian in a view: in front of the camera, and with a square of three deviations that touches the image.
All numbers come from the formulas of the float64 oracle, in float64, on the device of the Gaussians.
"""

import math
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, Gaussians
from diff_gaussian_rasterization.reference.camera import camera_of, project
from diff_gaussian_rasterization.reference.shape import activated, project_shapes, radii
from torch import Tensor

ROWS = 2**18  # Gaussians at a time: some 200 MB
_LOW, _HIGH, _PER_DECADE = -12, 12, 100
# Classes by which splats are compared: decades, but of opacities these limits.
_OPACITIES = (1 / 255, 0.1, 0.99)
_BASE = _HIGH - _LOW + 1


class Splats(NamedTuple):
    """Numbers of the Gaussians of a chunk that a view shows, float64 (M,)."""

    row: Tensor  # index of the Gaussian, int64
    ratio: Tensor  # longest over shortest axis in space
    length: Tensor  # px, standard deviation along the long axis of the dilated ellipse
    condition: Tensor  # of the dilated 2D covariance
    opacity: Tensor
    depth: Tensor  # world units in front of the camera


def sort_axes(gaussians: Gaussians) -> Tensor:
    """Standard deviations (N, 3) of activated Gaussians along their axes, longest first."""
    if gaussians.cov3d is None:
        return gaussians.scales.sort(1, descending=True).values
    square = gaussians.cov3d[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    return torch.linalg.eigvalsh(square).clamp(min=0).sqrt().flip(1)


def measure_splats(gaussians: Gaussians, settings: GaussianRasterizationSettings, raw: bool = True) -> Iterator[Splats]:
    """The splats of a view, chunk by chunk. Gaussians that are not finite are left out."""
    for start in range(0, len(gaussians.means), ROWS):
        part = Gaussians(*(None if values is None else values[start : start + ROWS].double() for values in gaussians))
        found = _measure_chunk(part, settings, raw)
        yield found._replace(row=found.row + start)


def _measure_chunk(part: Gaussians, settings: GaussianRasterizationSettings, raw: bool) -> Splats:
    """Measure the Gaussians of a chunk in a view, those that it does not show left out.

    raw: true if the values are those before activation.
    """
    with torch.device(part.means.device):  # where the oracle makes its constants
        camera = camera_of(settings)
        part = activated(part) if raw else part
        points = project(part.means, torch.zeros_like(part.means), camera)
        ellipses = project_shapes(part, points, camera, settings.scale_modifier)
        shown = radii(points, ellipses, camera) > 0
    xx, xy, yy = ellipses.covariance()
    determinant = (ellipses.r11 * ellipses.r22).square()
    largest = (xx + yy) / 2 + torch.sqrt(((xx - yy) / 2).square() + xy * xy)
    axes, opacity = sort_axes(part), part.opacities.reshape(-1)
    values = [axes[:, 0] / axes[:, 2], largest.sqrt(), largest.square() / determinant, opacity, points.depth]
    shown &= torch.stack([largest, opacity, points.depth, axes[:, 0]]).isfinite().all(0)
    row = shown.nonzero()[:, 0]
    return Splats(row, *(value[row] for value in values))


class Histogram:
    """Counts of positive numbers by their logarithm, a hundred bins a decade: quantiles are right within 2.4 %."""

    def __init__(self, device: torch.device | str) -> None:
        self.counts = torch.zeros((_HIGH - _LOW) * _PER_DECADE, dtype=torch.int64, device=device)
        self.least, self.most = math.inf, 0.0

    def add(self, values: Tensor) -> None:
        if len(values):
            bins = ((values.log10() - _LOW) * _PER_DECADE).clamp(0, len(self.counts) - 1).long()
            self.counts += torch.bincount(bins, minlength=len(self.counts))
            self.least, self.most = min(self.least, float(values.min())), max(self.most, float(values.max()))

    def quantile(self, share: float) -> float:
        """The number below which this share lies: its bin's middle, but the exact least and largest."""
        if share in (0.0, 1.0):
            return self.most if share else self.least
        place = int((self.counts.cumsum(0) < share * int(self.counts.sum())).sum())
        return min(max(10 ** ((place + 0.5) / _PER_DECADE + _LOW), self.least), self.most)

    def beyond(self, value: float, below: bool = False) -> float:
        """The share above a number, or below it; of its own bin half."""
        if value > self.most or value < self.least:
            return float((value > self.most) == below)
        place = min(max(int((math.log10(value) - _LOW) * _PER_DECADE), 0), len(self.counts) - 1)
        before, own = int(self.counts[:place].sum()), int(self.counts[place])
        share = (before + own / 2) / int(self.counts.sum())
        return share if below else 1 - share

    def curve(self) -> tuple[list[float], list[float]]:
        """Numbers, and the share above each, but of the largest."""
        used = self.counts.nonzero()[:-1, 0]
        above = 1 - self.counts.cumsum(0).double() / self.counts.sum()
        return (10 ** ((used + 1) / _PER_DECADE + _LOW)).tolist(), above[used].tolist()


class Sorted:
    """Numbers that fit into memory, with what `Histogram` tells, exactly."""

    def __init__(self, values: Tensor) -> None:
        self.values = values.sort().values.cpu()

    def quantile(self, share: float) -> float:
        """The number below which this share lies."""
        return float(self.values[round(share * (len(self.values) - 1))])

    def beyond(self, value: float, below: bool = False) -> float:
        """The share above a number, or below it."""
        asked = torch.tensor(value, dtype=self.values.dtype)
        before = int(torch.searchsorted(self.values, asked, right=not below))
        return (before if below else len(self.values) - before) / len(self.values)

    def curve(self) -> tuple[list[float], list[float]]:
        """Numbers, and the share above each, but of the largest; of many numbers a thousand, and the last thousand."""
        count = len(self.values)
        kept = torch.cat([torch.linspace(0, count - 1, min(count, 1000)).long(), torch.arange(count)[-1000:]])
        kept = kept.unique()[:-1]
        return self.values[kept].tolist(), (1 - (kept + 1).double() / count).tolist()


def count_cells(splats: Splats) -> Counter[tuple[int, ...]]:
    """Count the splats by their classes of ratio, length, condition, opacity and depth.

    The class of a number is its decade, so 2 for 100 to 1,000; that of an opacity is 0 below 1/255, 1 below 0.1, 2
    below 0.99, else 3.
    """
    code = torch.zeros_like(splats.row)
    for name in Splats._fields[1:]:
        values = getattr(splats, name)
        limits = torch.tensor(_OPACITIES, dtype=values.dtype, device=values.device)
        decade = values.log10().floor().clamp(_LOW, _HIGH).nan_to_num(_LOW).long() - _LOW
        code = code * _BASE + (torch.bucketize(values, limits, right=True) if name == "opacity" else decade)
    found = Counter()
    for number, count in zip(*(t.tolist() for t in code.unique(return_counts=True)), strict=True):
        digits = []
        for name in reversed(Splats._fields[1:]):
            number, digit = divmod(number, _BASE)
            digits.append(digit if name == "opacity" else digit + _LOW)
        found[tuple(reversed(digits))] = count
    return found
