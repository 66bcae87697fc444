"""Lenses: where a camera shows a direction, by COLMAP's models."""

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

_CHARTS = ("pinhole", "perspective", "equidistant", "equirectangular")  # gs::Chart in csrc/data.h
LENS_VALUES = 15  # focal lengths, principal point and coefficients
_SPARE = 1.3  # of the image's field of view, as the Jacobian's clamp of a pinhole
_TURN = 0.1  # radians that a fisheye's direction may have turned since a block fell asleep (csrc/math/sleep.h)
# Parameters of COLMAP's models behind focal lengths and principal point: name and place.
_RADIAL, _DIVISOR, _TANGENTIAL, _PRISM = "radial", "divisor", "tangential", "prism"
_BROWN = ((_RADIAL, 0), (_RADIAL, 1), (_TANGENTIAL, 0), (_TANGENTIAL, 1))
MODELS = {
    "SIMPLE_PINHOLE": ("perspective", 1, ()),
    "PINHOLE": ("perspective", 2, ()),
    "SIMPLE_RADIAL": ("perspective", 1, _BROWN[:1]),
    "RADIAL": ("perspective", 1, _BROWN[:2]),
    "OPENCV": ("perspective", 2, _BROWN),
    "FULL_OPENCV": ("perspective", 2, (*_BROWN, (_RADIAL, 2), (_DIVISOR, 0), (_DIVISOR, 1), (_DIVISOR, 2))),
    "SIMPLE_RADIAL_FISHEYE": ("equidistant", 1, _BROWN[:1]),
    "RADIAL_FISHEYE": ("equidistant", 1, _BROWN[:2]),
    "OPENCV_FISHEYE": ("equidistant", 2, tuple((_RADIAL, k) for k in range(4))),
    "THIN_PRISM_FISHEYE": ("equidistant", 2, (*_BROWN, (_RADIAL, 2), (_RADIAL, 3), (_PRISM, 0), (_PRISM, 1))),
    "EQUIRECTANGULAR": ("equirectangular", 0, ()),
}


class Lens(NamedTuple):
    """A lens. csrc/math/lens.h has the formulas of charts and distortion.

    focal, center: focal lengths and principal point, px, pixel centres at integers. The others: coefficients. The
    image of an equirectangular lens covers all directions: longitude across, latitude down.
    """

    chart: str  # perspective, equidistant or equirectangular
    focal: tuple[float, float]
    center: tuple[float, float]
    radial: tuple[float, ...] = (0.0,) * 4
    divisor: tuple[float, ...] = (0.0,) * 3
    tangential: tuple[float, ...] = (0.0,) * 2
    prism: tuple[float, ...] = (0.0,) * 2

    def scaled(self, across: float, down: float) -> "Lens":
        """The lens of an image that is so many times as wide and high."""
        x, y = ((at + 0.5) * by - 0.5 for at, by in zip(self.center, (across, down), strict=True))
        return self._replace(focal=(self.focal[0] * across, self.focal[1] * down), center=(x, y))

    @property
    def values(self) -> tuple[float, ...]:
        """The 15 numbers of its fields, in their order."""
        return *self.focal, *self.center, *self.radial, *self.divisor, *self.tangential, *self.prism

    def with_values(self, values: Sequence[float]) -> "Lens":
        """The lens of the same chart with other `values`."""
        ends = (2, 4, 8, 11, 13, 15)
        return Lens(self.chart, *(tuple(values[a:b]) for a, b in zip((0, *ends), ends, strict=False)))

    def numbers(self, width: int, height: int) -> tuple[float, ...]:
        """Return the lens as the operators take it (gs::Lens in csrc/data.h): 7 numbers, then the 15 `values`.

        ValueError for numbers that no lens has. The 7 numbers, in units of the chart where no other is named:

        chart: index in _CHARTS.
        limit: square of the largest distance from the axis that is shown.
        reach: factor by which the distortion widens the view, at least 1.
        field: distance from the axis at which the view ends (`field`).
        steep: largest distance, px, by which a point within the field moves for a unit; of a fisheye, for a radian by
            which its direction turns.
        beyond: smallest distance, px, from the image of all that lies outside of the field.
        slope: as steep, for a unit with any chart.

        width, height: size of the image, px.
        """
        if self.chart not in _CHARTS[1:]:
            raise ValueError(f"a lens's chart {self.chart!r} is none of {', '.join(_CHARTS[1:])}")
        more = self.values
        if not all(map(math.isfinite, more)) or min(self.focal) <= 0:
            raise ValueError(f"a lens needs finite numbers and focal lengths above 0, got {more}")
        field, turn, reach, *sleep = self._find_bounds(width, height)
        limit = turn if self.chart == "perspective" else field
        return float(_CHARTS.index(self.chart)), limit * limit, reach, field, *sleep, *more

    def field(self, width: int, height: int) -> float:
        """The field of an image: an angle from the axis (radians), or its tangent for a perspective chart.

        It ends where the distortion turns back, and a little outside of the image's corners. A fisheye shows no
        Gaussian beyond it, a perspective lens all up to where its distortion turns back.
        """
        return self._find_bounds(width, height)[0]

    @functools.lru_cache(maxsize=4096)  # noqa: B019  (a lens is a value)
    def _find_bounds(self, width: int, height: int) -> tuple[float, ...]:
        """Return field, turn, reach, steep, beyond and slope, all but `turn` as `numbers` explains them.

        turn: distance from the axis at which the distortion turns back, infinite if it never does. steep and beyond
            tell whether a view may show a block of Gaussians that sleeps (csrc/math/sleep.h: blocks that no view shows
            miss steps); slope is for Gaussians on their rays.
        """
        if self.chart == "equirectangular":
            return math.inf, math.inf, 1.0, math.inf, 0.0, max(self.focal)
        r = np.polynomial.Polynomial([0.0, 1.0])
        over, under = (np.polynomial.Polynomial([1.0, *terms])(r * r) for terms in (self.radial, self.divisor))
        # The derivative of the distorted radius, where tangential and prism terms take most of it.
        aside = math.hypot(*(3 * p + s for p, s in zip(self.tangential[::-1], self.prism, strict=True)))
        slope = (over + r * over.deriv() - 2 * aside * r * under) * under - r * over * under.deriv()
        roots = np.concatenate([slope.roots(), under.roots()])
        turn = min((float(root.real) for root in roots if abs(root.imag) < 1e-9 and root.real > 0), default=math.inf)
        corner = max(
            math.hypot((x - self.center[0]) / self.focal[0], (y - self.center[1]) / self.focal[1])
            for x in (-0.5, width - 0.5)
            for y in (-0.5, height - 0.5)
        )
        radii = np.linspace(0, min(turn, 4 * corner, math.pi if self.chart == "equidistant" else math.inf), 4097)
        shrunk = over(radii) / under(radii)
        inside = radii * shrunk <= corner
        field, reach = min(turn, _SPARE * float(radii[inside][-1])), max(1.0, 1 / float(shrunk[inside].min()))
        box = (
            (_SPARE + abs((2 * at + 1) / size - 1)) * reach * size / (2 * focal)
            for at, size, focal in zip(self.center, (width, height), self.focal, strict=True)
        )
        fisheye = self.chart == "equidistant"
        farthest = field if fisheye else max(field, math.hypot(*box))  # a perspective lens's Jacobian is clamped there
        radii = np.linspace(0, farthest, 4097)
        shrunk, slopes = over(radii) / under(radii), slope(radii) / under(radii) ** 2
        steep = 1.01 * float(np.maximum(np.abs(slopes) + 2 * aside * radii, np.abs(shrunk)).max())
        steep += 2 * aside * farthest
        if any(abs(root.imag) < 1e-9 and 0 < root.real <= farthest for root in under.roots()):
            steep = math.inf
        steep *= max(self.focal)
        if fisheye:  # what is beside the axis is stretched by angle / sine
            edge = field + _TURN  # a direction that turns past the one behind can jump to any other
            turned = steep * edge / math.sin(edge) if edge < math.pi else math.inf
            return field, turn, reach, turned, math.inf, steep
        beyond = field * float(over(field) / under(field)) - aside * field**2 - corner
        return field, turn, reach, steep, min(self.focal) * beyond, steep


def lens_of(model: str, params: tuple[float, ...]) -> Lens:
    """The lens of a COLMAP camera, whose parameters count pixel centres from a half. KeyError for an unknown model."""
    chart, focals, places = MODELS[model]
    if chart == "equirectangular":
        width, height = params
        return Lens(chart, (width / (2 * math.pi), height / math.pi), ((width - 1) / 2, (height - 1) / 2))
    focal = (params[0], params[focals - 1])
    center = (params[focals] - 0.5, params[focals + 1] - 0.5)
    lens = Lens(chart, focal, center)
    terms = {name: list(getattr(lens, name)) for name in (_RADIAL, _DIVISOR, _TANGENTIAL, _PRISM)}
    for (name, place), value in zip(places, params[focals + 2 :], strict=True):
        terms[name][place] = float(value)
    return lens._replace(**{name: tuple(values) for name, values in terms.items()})
