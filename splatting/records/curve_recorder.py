"""The recorder of a model's error over its training time; it changes no bit of the model."""

import contextlib
import random
import subprocess
import sys
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import TypeVar

import torch
from tqdm import tqdm

from groundwork.host.clock import running_seconds, wall_seconds
from groundwork.host.machine import cores
from splatting.records.error_curve import COLUMNS, FIGURE, NAME, SUBSET, Row, gain_since_peak, peak_advice, write_curve
from splatting.records.training_log import TrainingLog
from utils.system_utils import UserError, writes_files

AHEAD, MANY_CORES = 2.0, 4  # seconds before the end at which drawing gets ready, where that takes no core from training
SHORTEST = 200  # iterations of a training that is scored between, too
GRIDS = ((4, 32), (2, 12))  # points while the number of iterations doubles, and their number before the last iteration
SHARE = 0.025  # of a training that scoring may take by its estimate; 0.05 is promised, and early points may be dearer
MOST_SHARE = 0.05  # the same where one view of each set at each point takes more than SHARE
FEW_VIEWS, FEW_POINTS = 8, 6  # test views, all of which are scored where that leaves so many points
REPLANNED = 1.5  # times as many iterations as were expected, or more, get points of their own
VIEW_COST = 0.5  # of scoring a view, in iterations: it takes no gradient and no step
_ROOT = Path(__file__).resolve().parents[2]
View = TypeVar("View")


def curve_points(
    iterations: int, whole: Iterable[int], sets: int, views: int, taken: float | None = None
) -> tuple[frozenset[int], int]:
    """Return the iterations that a curve scores besides `whole`, and how many views of a set it scores there.

    The points are evenly spaced in the logarithm of the iteration. They follow from the options alone, so that the same
    command scores the same on every machine. They score as many views as fit SHARE of the training, at least one, on
    the coarse grid; all views on the fine grid where that fits, too. A part is a power of two, so that runs of nearly
    as many iterations score the same part. One of FEW_VIEWS would tell little of all, so these are scored at fewer
    points, if need be without train views.

    iterations: last iteration of the schedule.
    whole: iterations that score all views.
    sets: number of sets.
    views: number of views of each set.
    taken: iterations of a run whose schedule has `iterations`, None: the same number. With a number there is the coarse
        grid alone.
    """
    (fine, many), coarse = GRIDS
    if iterations < SHORTEST or (taken is not None and coarse[1] * VIEW_COST > MOST_SHARE * taken):
        return frozenset(), 1
    whole = {t for t in whole if 0 < t < iterations} | {iterations}
    scored, ends = (iterations if taken is None else taken) / VIEW_COST, len(whole) * sets * views
    budget = SHARE * scored - ends
    density, count = (fine, many) if taken is None and budget >= sets * views * many else coarse
    most = max(1, int(budget / (sets * count)))
    for each in (sets * views, views) if most < views <= FEW_VIEWS else ():
        if (fit := min(int((MOST_SHARE * scored - ends) / each), count)) >= FEW_POINTS:
            density, count, most = density * fit / count, fit, views
            break
    places = {round(iterations * 2 ** (-place / density)) for place in range(1, count + 1)}
    return frozenset(places - whole), views if most >= views else 1 << (most.bit_length() - 1)


def evenly_spread(views: Sequence[View], count: int) -> list[View]:
    """Return `count` of the views, or all if there are fewer; the first and the last are among two or more."""
    count = min(count, len(views))
    return [views[round(index * (len(views) - 1) / max(count - 1, 1))] for index in range(count)]


def drawn(views: Sequence[View], count: int) -> list[View]:
    """Draw `count` of the views with a fixed seed, in their order. A larger count includes those of a smaller one."""
    indices = list(range(len(views)))
    random.Random(0).shuffle(indices)
    return [views[index] for index in sorted(indices[:count])]


def _mean_scores(name: str, of_views: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the mean of each score over the views of a set that have the score, by column."""
    kinds = dict.fromkeys(kind for scores in of_views for kind in scores)
    return {f"{name}_{kind}": round(fmean(x[kind] for x in of_views if kind in x), 6) for kind in kinds}


class CurveDrawer:
    """A process that draws the curve of a folder, because matplotlib takes a second that training has better use for.

    Call `begin`, `draw` and `finish` in that order; `abandon` at any time.

    views: number of views of each set, for the legend.
    """

    def __init__(self, folder: Path, views: Mapping[str, int]) -> None:
        self._folder = folder.resolve()
        self._views = [str(views[name]) for name in ("test", "train")]
        self._process: subprocess.Popen | None = None

    def begin(self) -> None:
        """Start the process, unless it runs already, so that it imports matplotlib meanwhile."""
        if self._process is not None:
            return
        files = [str(self._folder / name) for name in (NAME, FIGURE)]
        with contextlib.suppress(OSError):  # `finish` says so
            title = "/".join(self._folder.parts[-3 if self._folder.name.startswith("seed_") else -1 :])
            words = [*files, title, *self._views]
            self._process = subprocess.Popen(
                [sys.executable, "-X", "utf8", "-m", "splatting.records.figures", *words],
                cwd=_ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, encoding="utf-8",
                start_new_session=True,  # Ctrl-C is for the training, which ends this process if need be
            )  # fmt: skip

    def draw(self) -> None:
        """Let the process draw the rows that the file has now."""
        if self._process is not None and self._process.stdin.closed:  # drawn where a repeated training went on
            self.abandon()
            self._process = None
        self.begin()
        if self._process is not None:
            with contextlib.suppress(OSError):  # it has ended, and `finish` says so
                self._process.stdin.write("draw\n")
                self._process.stdin.close()

    def finish(self) -> str | None:
        """Wait until the curve is drawn. Return what went wrong, None if nothing did."""
        if self._process is None:
            return "no process can be started to draw it"
        try:
            said, status = self._process.stdout.read().strip(), self._process.wait()
        finally:
            self.abandon()  # if a signal has interrupted the waiting
        return said or (f"the process that draws it ended with status {status}" if status else None)

    def abandon(self) -> None:
        """End the process, if there is one."""
        if self._process is not None:
            self._process.kill()
            for pipe in (self._process.stdin, self._process.stdout):
                with contextlib.suppress(OSError):
                    pipe.close()
            self._process.wait()


class CurveRecorder:
    """Scores views in the iterations of a plan, keeps the curve's file up to date, and draws the curve at the end.

    Iterations are those of the schedule. The last one and those of `always` score all views. Iterations between score a
    part of each set, which is always the same (`curve_points`, `drawn`). Where all views are scored, that part has a
    row of its own, before theirs. A run that is not steady has no points between until its number of iterations is
    known. If the file cannot be written, one warning says so and the next point tries again: a training is worth more
    than its curve.

    rows: rows of the runs that this one resumes.
    log: log of the training, with the seconds of these runs.
    iterations: the last iteration.
    always: iterations that score all views.
    views: views to score, by set, "test" and "train".
    load: function that decodes the photos of views.
    scores: function that returns the scores of a view by name, none if no pixel counts.
    steady: true if the iterations of the run are those of the schedule.
    """

    def __init__(
        self,
        model_path: str,
        rows: list[Row],
        log: TrainingLog,
        iterations: int,
        always: Sequence[int],
        views: dict[str, Sequence[View]],
        load: Callable[[Sequence[View]], None],
        scores: Callable[[View], dict[str, float]],
        device: torch.device,
        steady: bool = True,
    ) -> None:
        """Plan the points, unless the number of iterations is not known yet.

        model_path: model folder, into which curve and figure are written.
        device: device that trains, whose work is done before a score begins.
        """
        self.rows = rows
        self._folder = Path(model_path)
        self._log = log
        self._iterations = iterations
        self._whole = {*always, iterations}
        self._views, self._steady = views, steady
        self._all = {name: range(len(of_set)) for name, of_set in views.items()}
        self._part: dict[str, Sequence[int]] = {}  # of each set's views, what points between score
        self._planned = 0.0  # for so many iterations
        self._points = self._whole
        if steady:
            self._plan(iterations)
        self._load = load
        self._scores = scores
        self._device = device
        self._scored = self._scored_in_part = 0
        self._spent = dict.fromkeys(("scoring", "writing", "drawing", "loading"), 0.0)  # seconds
        self._warned = False
        self._drawer = CurveDrawer(self._folder, {name: len(of_set) for name, of_set in views.items()})
        self._ahead = AHEAD if cores() >= MANY_CORES else 0.0

    def _plan(self, taken: float) -> None:
        """Choose the points of a run that takes so many iterations, and the part of the views that they score."""
        self._planned = taken
        count = len(self._all["test"])
        between, size = curve_points(
            self._iterations, self._whole, len(self._all), count, None if self._steady else taken
        )
        before = [int(row[SUBSET]) for row in self.rows if row[SUBSET] is not None]
        if before and not self._steady:
            size = before[-1]
        ends = count * sum(0 < iteration <= self._iterations for iteration in self._whole)
        dear = len(self._all) * (ends + size * len(between)) * VIEW_COST > MOST_SHARE * taken
        sets = ["test"] if dear else list(self._all)
        self._part = {name: drawn(self._all[name], size) for name in sets} if between else {}
        self._points = self._whole | between

    def _subset_size(self, part: Mapping[str, Sequence[int]]) -> int | None:
        """Return the number of test views in a part of the sets, None if it has all of them."""
        return len(part["test"]) if len(part["test"]) < len(self._all["test"]) else None

    def point(self, span: range) -> int | None:
        """Return the iteration to score among those that a step stands for; None: there is none."""
        return max(self._points.intersection(span), default=None)

    def due(self, span: range, first: int, seconds: float, taken: float | None = None) -> bool:
        """Tell whether to `add` a point in the step of a span. If so, wait for the GPU.

        Shortly before the end, the drawing process starts, too.

        span: iterations that the step stands for.
        first: iteration of the schedule at which this run began.
        seconds: seconds of training since then.
        taken: number of iterations of a run that is not steady, as far as it is known.
        """
        if not span:
            return False
        if not self._steady and taken is not None and taken > REPLANNED * self._planned:
            self._plan(taken)
        left, done = self._iterations - span[-1], span[-1] - first
        if writes_files() and seconds * left <= self._ahead * done:
            self._drawer.begin()
        due = self.point(span) is not None
        if due and self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        return due

    def add(self, iteration: int, seconds: float, gaussians: int, trained: int | None = None) -> None:
        """Score the views, and write the curve with the new point. The last point also starts the drawing.

        iteration: iteration of the schedule.
        seconds: seconds of training in this run.
        gaussians: number of Gaussians.
        trained: iteration of the run, None: the same.
        """
        # The peaks of log and curve, because after an error the curve may have rows beyond the log's last record.
        peaks = [self._log.peak_memory_mib(), *(row["peak_memory_mib"] for row in self.rows[-1:])]
        row = dict.fromkeys(COLUMNS) | {
            "iteration": iteration if trained is None else trained,
            "seconds": round(self._log.seconds_before + seconds, 3),
            "wall_seconds": round(self._log.wall_seconds_before + wall_seconds(), 3),
            "gaussians": gaussians,
            "peak_memory_mib": max((peak for peak in peaks if peak is not None), default=None),
        }
        if not self._scored:  # photos that training mostly needs soon: no part of the cost
            self._measure_time(
                "loading", lambda: self._load([view for of_set in self._views.values() for view in of_set])
            )
        whole = iteration in self._whole
        parts = [self._all] if whole else [self._part]
        if whole and self._part and self._subset_size(self._part) is not None:
            parts.insert(0, self._part)
        self._measure_time("scoring", lambda: self._score(row, parts))
        self._scored += 1
        self._scored_in_part += self.rows[-1][SUBSET] is not None
        self._measure_time("writing", self._write)
        if iteration == self._iterations and writes_files():
            self._drawer.draw()

    def _measure_time(self, part: str, call: Callable[[], object]) -> None:
        start = running_seconds()
        call()
        self._spent[part] += running_seconds() - start

    def _score(self, row: Row, parts: Sequence[Mapping[str, Sequence[int]]]) -> None:
        """Add a row for each of the parts, the last of which has all views of the others."""
        scores = {name: {i: self._scores(self._views[name][i]) for i in of_set} for name, of_set in parts[-1].items()}
        for part in parts:
            means = {SUBSET: self._subset_size(part)}
            for name, indices in part.items():
                means |= _mean_scores(name, [scores[name][i] for i in indices])
            self.rows.append(row | means)

    def _write(self) -> None:
        """Write the file of the curve. The first failure is a warning, and the training goes on."""
        try:
            write_curve(self._folder / NAME, self.rows)
        except UserError as error:
            if not self._warned:
                tqdm.write(f"warning: {error}; training continues without its curve", file=sys.stderr)
            self._warned = True

    def finish(self, seconds: float, saved: Container[int], steady: bool) -> None:
        """Wait for the figure, print where it is, and give `peak_advice`.

        The log's last record gets the costs: `curve_scoring_seconds`, `curve_writing_seconds` (of the file),
        `curve_drawing_seconds` (of waiting), and `curve_loading_seconds` (of photos, before the first scoring).

        seconds: seconds of training in this run.
        saved: iterations whose PLY this training has written; advice on one of them is to render it.
        steady: true if another training has the same iterations, so that advice may name one to save; not by the clock.
        """
        if writes_files():
            self._measure_time("drawing", self._draw)
        costs = {f"curve_{part}_seconds": round(taken, 4) for part, taken in self._spent.items()}
        self._log.add(self.rows[-1]["iteration"], seconds, **costs)
        often = "once" if self._scored == 1 else f"{self._scored} times"
        if self._scored_in_part:
            often += f" ({self._scored_in_part} of them on {len(self._part['test'])} of {len(self._all['test'])} views)"
        self._log.tell(f"Test PSNR measured {often}, {self._spent['scoring']:.1f} s: {self._folder / FIGURE}")
        if advice := peak_advice(self.rows, saved, steady):
            # Where training overfits, `check_overfitting` says more, and one line is printed.
            (self._log.keep if gain_since_peak(self.rows) else self._log.advise)(advice)

    def _draw(self) -> None:
        if failure := self._drawer.finish():
            print(f"warning: no {FIGURE}: {failure}", file=sys.stderr)

    def abandon(self) -> None:
        """Draw nothing, as the training did not reach its end."""
        self._drawer.abandon()
