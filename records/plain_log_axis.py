"""A logarithmic axis with plain numbers at its ticks."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axis import Axis


def plain_log_axis(axis: Axis) -> None:
    """Label a logarithmic axis at 1, 2, 5, 10, 20, ...: matplotlib's own labels 3 x 10^0 and 4 x 10^0 overlap."""
    from matplotlib.ticker import LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())
