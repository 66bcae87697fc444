"""Colours of depth, counts and errors, and the scale with numbers that the page shows for them."""

from typing import NamedTuple

import torch
from torch import Tensor

ERROR_GAIN = 5  # as in the contact sheets
_FEW, _MOST = 0.02, 0.98  # quantiles of the depths of a frame that get the darkest and the brightest colour
_SAMPLE = 20_000  # pixels that the quantiles are taken from
# From dark to bright, so that a grey print keeps the order.
_STOPS = ((0.00, 0.00, 0.05), (0.25, 0.05, 0.42), (0.70, 0.18, 0.38), (0.97, 0.50, 0.16), (0.99, 1.00, 0.70))
_GREYS = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
_TICKS = (0.0, 0.25, 0.5, 0.75, 1.0)  # places on a scale that get a number


class Legend(NamedTuple):
    """title: what the colours mean. numbers: along the scale, from its dark to its bright end. stops: its colours.

    warning: what the frame lacks. sides: which image is where.
    """

    title: str = ""
    numbers: tuple[float, ...] = ()
    stops: tuple[tuple[float, float, float], ...] = _STOPS
    warning: str = ""
    sides: str = ""

    def make_html(self) -> str:
        """Make the HTML of the legend; empty if there is nothing to show."""
        parts = [text for text in (self.warning, self.sides, self.title) if text]
        if self.numbers:
            colours = ", ".join(f"rgb({', '.join(f'{100 * x:g}%' for x in stop)})" for stop in self.stops)
            parts.append(f'<div style="height:0.8em;background:linear-gradient(to right, {colours})"></div>')
            numbers = "".join(f"<span>{_shorten(number)}</span>" for number in self.numbers)
            parts.append(f'<div style="display:flex;justify-content:space-between">{numbers}</div>')
        content = "".join(f"<div>{part}</div>" for part in parts)
        return f'<div style="padding:0 0.8em 0.4em;font-size:0.85em;line-height:1.4">{content}</div>' if parts else ""


def _shorten(number: float) -> str:
    return f"{number:,.0f}" if number >= 100 else f"{number:.3g}"


def apply_colors(values: Tensor) -> Tensor:
    """Colours (3, H, W) of values (H, W) in [0, 1], linear between the stops; others are clamped."""
    stops = torch.tensor(_STOPS, dtype=values.dtype, device=values.device)
    place = values.clamp(0, 1) * (len(_STOPS) - 1)
    below = place.long().clamp_max(len(_STOPS) - 2)
    return torch.lerp(stops[below], stops[below + 1], (place - below)[..., None]).permute(2, 0, 1)


def color_depth(depth: Tensor, alpha: Tensor) -> tuple[Tensor, Legend]:
    """Colours (3, H, W) of the planes of `view_planes`, (1, H, W) each; depth is inverse: near is bright.

    Where less than half of a pixel is covered there is no depth, and the colour is black.
    """
    there = alpha[0] >= 0.5
    values = depth[0] / alpha[0].clamp_min(1e-6)
    known = values[there]
    if not len(known):
        return torch.zeros_like(alpha).expand(3, -1, -1), Legend("Depth: nothing is covered by half or more")
    known = known[:: max(1, len(known) // _SAMPLE)]
    far, near = torch.quantile(known, torch.tensor([_FEW, _MOST], dtype=known.dtype, device=known.device)).tolist()
    span = max(near - far, 1e-9)
    numbers = tuple(1 / max(far + tick * span, 1e-9) for tick in _TICKS)
    colours = torch.where(there, apply_colors((values - far) / span), 0.0)
    return colours, Legend("Depth, far to near, in units of the scene", numbers)


def color_counts(counts: Tensor) -> tuple[Tensor, Legend]:
    """Colours (3, H, W) of counts (H, W): linear, the largest of the image is the brightest."""
    most = max(int(counts.max()), 1)
    return apply_colors(counts.float() / most), Legend("Gaussians per pixel", tuple(tick * most for tick in _TICKS))


def draw_error(target: Tensor, render: Tensor) -> Tensor:
    """The difference (3, H, W) of two images in [0, 1], times ERROR_GAIN."""
    return ((target - render).abs() * ERROR_GAIN).clamp(0, 1)


ERROR_SCALE = Legend(
    "Error: black where photo and render agree, brighter where they differ, in the colour in which they do (of 255)",
    tuple(255 / ERROR_GAIN * tick for tick in _TICKS),
    _GREYS,
)
