"""error_vs_time.png: the curve of a training as a figure, drawn in a process of its own.

matplotlib takes a second, and training has other things to do. `python -m ....curve_figure CSV PNG TITLE` imports
it, waits for a line on its standard input, draws, and prints what went wrong; without a line it draws nothing.
"""

from __future__ import annotations

import contextlib
import gc
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from splatting.evaluation.error_curve import FIGURE, NAME, SUBSET, Row, best_test, read_curve, whole_sets
from splatting.host.session import own_session
from utils.system_utils import atomic_write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

HOLLOW = {"fillstyle": "none", "linewidth": 0.7, "markersize": 4}  # points of subsets
COLORS = {"test": "#0072B2", "train": "#D55E00"}  # told apart by the colour-blind (Okabe and Ito)
Value = Callable[[Row, str], float | None]
_ROOT = Path(__file__).resolve().parents[2]


class CurveDrawer:
    """The process that draws the curve of a folder. `begin`, `draw`, `finish` in that order; `abandon` at any time."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder.resolve()
        self._process: subprocess.Popen | None = None

    def begin(self) -> None:
        """Start the process, unless that was done, so that it imports matplotlib meanwhile."""
        if self._process is not None:
            return
        files = [str(self._folder / name) for name in (NAME, FIGURE)]
        with contextlib.suppress(OSError):  # `finish` says so
            self._process = subprocess.Popen(
                [sys.executable, "-X", "utf8", "-m", __name__, *files, self._folder.name], cwd=_ROOT,
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, encoding="utf-8",
                **own_session(),  # Ctrl-C is for the training, which ends this process if need be
            )  # fmt: skip

    def draw(self) -> None:
        """Draw what the file has now."""
        self.begin()
        if self._process is not None:
            with contextlib.suppress(OSError):  # it has ended, and `finish` says so
                self._process.stdin.write("draw\n")
                self._process.stdin.close()

    def finish(self) -> str | None:
        """Wait until it is drawn. Returns what went wrong, None if nothing did."""
        if self._process is None:
            return "no process can be started to draw it"
        try:
            said = self._process.stdout.read().strip()
            status = self._process.wait()
        finally:
            self.abandon()  # if a signal has interrupted the waiting
        return said or (f"the process that draws it ended with status {status}" if status else None)

    def abandon(self) -> None:
        """End the process, if there is one."""
        if self._process is None:
            return
        self._process.kill()
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(OSError):
                pipe.close()
        self._process.wait()


def psnr(row: Row, views: str) -> float | None:
    return row[f"{views}_psnr"]


def dissimilarity(row: Row, views: str) -> float | None:
    """1 - SSIM; None for equal images, which have no place on a logarithmic axis."""
    ssim = row[f"{views}_ssim"]
    return None if ssim is None or ssim >= 1 else 1 - ssim


def points(rows: Sequence[Row], value: Value, views: str) -> list[tuple[float, float]]:
    """Seconds and values of the rows that have them; the axis of the seconds is logarithmic."""
    pairs = ((row["seconds"], value(row, views)) for row in rows)
    return [(seconds, number) for seconds, number in pairs if seconds > 0 and number is not None]


def plain_log_axis(axis: Axis) -> None:
    """Label a logarithmic axis at 1, 2, 5, 10, 20, ...: matplotlib's own labels 3 x 10^0 and 4 x 10^0 overlap."""
    from matplotlib.ticker import LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def draw_curve(path: str | os.PathLike, rows: list[Row], title: str) -> None:
    """Draw PSNR and 1 - SSIM of test and train views against seconds of training, the gap between both shaded.

    Points that score a subset of the views are hollow, and have a thin line of their own.
    Raises matplotlib's errors, ImportError if it is missing, and UserError if `path` cannot be written.
    """
    from matplotlib.figure import Figure  # imported here: it takes long, and no training depends on it

    figure = Figure(figsize=(7.5, 7.0), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    _compare(upper, rows, psnr, " dB")
    _compare(lower, rows, dissimilarity, "")
    if best := best_test(rows):
        label = f"best test: {best['test_psnr']:.2f} dB, iteration {best['iteration']}"
        upper.plot(best["seconds"], best["test_psnr"], "*", color="black", markersize=12, label=label)
    upper.set(title=title, ylabel="PSNR, dB", xscale="log")
    plain_log_axis(lower.xaxis)
    lower.set(ylabel="1 - SSIM", xlabel="seconds of training, without evaluation and saving")
    if lower.lines:
        lower.set_yscale("log")
        plain_log_axis(lower.yaxis)
    for axes in (upper, lower):
        axes.grid(alpha=0.3, which="both", linewidth=0.5)
        if axes.lines:
            axes.legend()
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=120)


def _compare(axes: Axes, rows: list[Row], value: Value, unit: str) -> None:
    """Draw lines of test and train views, of whole sets and of subsets, and shade the gap between test and train."""
    parts = [row for row in rows if row[SUBSET] is not None]
    for kind, style in ((parts, HOLLOW), (whole_sets(rows), {})):
        for views, color in COLORS.items():
            if found := points(kind, value, views):
                label = f"{views} views" + (f", {min(row[SUBSET] for row in kind)} of them" if style else "")
                axes.plot(
                    *zip(*found, strict=True),
                    **{"marker": "o", "markersize": 3, "color": color, "label": label} | style,
                )
        both = [row for row in kind if None not in (value(row, "test"), value(row, "train")) and row["seconds"] > 0]
        if both:
            ends = [[value(row, views) for row in both] for views in COLORS]
            label = None if style else f"gap, {abs(ends[1][-1] - ends[0][-1]):.3g}{unit} at the end"
            seconds = [row["seconds"] for row in both]
            axes.fill_between(seconds, *ends, color="gray", alpha=0.2, linewidth=0, label=label)


def main() -> None:
    """Draw for `CurveDrawer`."""
    gc.disable()  # for the second that this takes
    with contextlib.suppress(Exception):  # drawing reports it
        import matplotlib.backends.backend_agg
        import matplotlib.figure  # noqa: F401
    if sys.stdin.readline():
        source, target, title = sys.argv[1:]
        try:
            draw_curve(target, read_curve(source), title)
        except Exception as error:  # a broken matplotlib may raise anything, and the model is trained
            print(f"{type(error).__name__}: {error}")


if __name__ == "__main__":
    main()
