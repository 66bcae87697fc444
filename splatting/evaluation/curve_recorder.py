"""Recorder of a model's error against its run time of training; it changes no bit of the model."""

import contextlib
import random
import subprocess
import sys
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import TypeVar

import numpy as np
import torch
from tqdm import tqdm

from splatting.evaluation.error_curve import COLUMNS, ESTIMATED, FIGURE, NAME, SCORES, SUBSET, Row, write_curve
from splatting.evaluation.training_log import TrainingLog
from splatting.evaluation.what_to_try import gain_since_peak, peak_advice
from splatting.host.clock import running_seconds, wall_seconds
from splatting.host.machine import cores
from utils.system_utils import UserError, writes_files

AHEAD, MANY_CORES = 2.0, 4  # seconds before the end at which drawing gets ready, where that takes no core from training
SHORTEST = 200  # iterations of a training that is scored between, too
GRIDS = ((4, 32), (2, 12))  # points while the number of iterations doubles, and their number before the last iteration
SHARE = 0.025  # of a training that scoring may take by its estimate; 0.05 is promised, and early points may be dearer
MOST_SHARE = 0.05  # the same where one view of each set at each point takes more than SHARE
WHOLE_SHARE = 0.075  # the same for --whole_curve, where 0.1 is promised
REPLANNED = 1.5  # times as many iterations as were expected, or more, get points of their own
VIEW_COST = 0.5  # of scoring a view, in iterations: it takes no gradient and no step
_ROOT = Path(__file__).resolve().parents[2]
View = TypeVar("View")


def curve_points(
    iterations: int, whole: Iterable[int], sets: int, views: int, taken: float | None = None
) -> tuple[frozenset[int], int]:
    """The iterations that a curve scores between those of `whole`, which score all views; and how many views of a set.

    The points are evenly spaced in the logarithm of the iteration, and follow from the options alone, so that the same
    command scores the same on every machine. They score as many views as fit SHARE of the training, at least one, on
    the coarse grid; all views on the fine one where that fits, too. sets: of `views` each. taken: the iterations of a
    run whose schedule has `iterations`, None: the same. Then there is the coarse grid alone.
    """
    (fine, many), coarse = GRIDS
    if iterations < SHORTEST or (taken is not None and coarse[1] * VIEW_COST > MOST_SHARE * taken):
        return frozenset(), 1
    whole = {t for t in whole if 0 < t < iterations} | {iterations}
    budget = SHARE * (iterations if taken is None else taken) / VIEW_COST - len(whole) * sets * views
    density, count = (fine, many) if taken is None and budget >= sets * views * many else coarse
    places = {round(iterations * 2 ** (-place / density)) for place in range(1, count + 1)}
    return frozenset(places - whole), max(1, min(views, int(budget / (sets * count))))


def whole_points(
    iterations: int, whole: Iterable[int], sets: int, views: int, taken: float | None = None
) -> dict[int, int]:
    """The iterations of `curve_points`' coarse grid, and how many of the `views` of the test set each scores.

    As many as WHOLE_SHARE allows score all of them: the last ones, since the levels that are compared lie near the end,
    and the first one, for the `Estimates`. The others score one view each, or if none can score all, each the same
    number. taken: as in `curve_points`.
    """
    density, count = GRIDS[1]
    whole = {t for t in whole if 0 < t < iterations} | {iterations}
    places = {round(iterations * 2 ** (-place / density)) for place in range(1, count + 1)} - whole - {0}
    left = (
        WHOLE_SHARE * (iterations if taken is None else taken) / VIEW_COST - len(whole) * sets * views - len(places)
    )  # beyond one view a point
    full = min(len(places), max(0, int(left / max(views - 1, 1))))
    size = 1 if full else max(1, min(views, int(left / max(len(places), 1)) + 1))
    first, *others = sorted(places) or [0]
    order = [*others[-1:], first, *others[-2::-1]]
    return {t: views if place < full else size for place, t in enumerate(order) if t}


def evenly_spread(views: Sequence[View], count: int) -> list[View]:
    """`count` of the views, or all if there are fewer; with two or more, the first and the last are among them."""
    count = min(count, len(views))
    return [views[round(index * (len(views) - 1) / max(count - 1, 1))] for index in range(count)]


def drawn(views: Sequence[View], count: int) -> list[View]:
    """`count` of the views, drawn with a fixed seed and in their order. A larger count has those of a smaller one."""
    indices = list(range(len(views)))
    random.Random(0).shuffle(indices)
    return [views[index] for index in sorted(indices[:count])]


class CurveDrawer:
    """A process that draws the curve of a folder: matplotlib takes a second, and training has other things to do.

    `begin`, `draw`, `finish` in that order; `abandon` at any time. views: how many each set has, for the legend.
    """

    def __init__(self, folder: Path, views: Mapping[str, int]) -> None:
        self._folder = folder.resolve()
        self._views = [str(views[name]) for name in ("test", "train")]
        self._process: subprocess.Popen | None = None

    def begin(self) -> None:
        """Start the process, unless that was done, so that it imports matplotlib meanwhile."""
        if self._process is not None:
            return
        files = [str(self._folder / name) for name in (NAME, FIGURE)]
        with contextlib.suppress(OSError):  # `finish` says so
            title = "/".join(self._folder.parts[-3 if self._folder.name.startswith("seed_") else -1 :])
            words = [*files, title, *self._views]
            self._process = subprocess.Popen(
                [sys.executable, "-X", "utf8", "-m", "splatting.evaluation.figures", *words],
                cwd=_ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, encoding="utf-8",
                start_new_session=True,  # Ctrl-C is for the training, which ends this process if need be
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


class Estimates:
    """Turns scores of a subset into those of the whole sets, in rows of a curve.

    A subset's views are easier or harder than all of them. By how much is known wherever all were scored. Between two
    such scores of the subset it is interpolated, and outside of them taken as at the nearest.

    rows: those of an earlier part of the training; its subsets that are not estimated yet will be.
    """

    def __init__(self, rows: Sequence[Row], views: Mapping[str, Sequence[View]]) -> None:
        self._sizes = {name: len(of_set) for name, of_set in views.items()}
        self._raw: list[tuple[Row, Row]] = []  # a row of a subset, and its scores as measured
        self._known: list[Mapping[str, Sequence[float]]] = []  # the scores of each view
        for row in rows:
            if row[SUBSET] is not None and not row[ESTIMATED]:
                self.add(row, {})

    def add(self, row: Row, scores: Mapping[str, Sequence[float]]) -> None:
        """Take a scored row in. scores: by column, those of each view, in the order of the set."""
        if row[SUBSET] is None:
            self._known.append(scores)
        else:
            self._raw.append((row, {name: row[name] for name in SCORES if row[name] is not None}))
        for old, raw in self._raw if row[SUBSET] is None else self._raw[-1:]:
            whole = {name: self._whole(name, value, int(old[SUBSET] or 0)) for name, value in raw.items()}
            old |= {} if None in whole.values() else whole | {ESTIMATED: 1}

    def _whole(self, name: str, value: float, size: int) -> float | None:
        """The score of all views for that of a subset of `size`; None if that is not known."""
        count = self._sizes[name.partition("_")[0]]
        there = drawn(range(count), size)
        known = {}
        for scores in self._known:
            of_views = scores.get(name, ())
            # Some are left out where no pixel of them counts; the PSNR of equal images is infinite.
            if len(of_views) == count and np.isfinite(of_views).all():
                part = fmean(of_views[i] for i in there)
                known[part] = fmean(of_views) - part
        if not known:
            return None
        parts, offsets = zip(*sorted(known.items()), strict=True)
        return round(value + float(np.interp(value, parts, offsets)), 6)


class CurveRecorder:
    """Scores views in the iterations of a plan, keeps the curve's file up to date, and draws it at the end.

    rows: those of the runs that this one resumes; `log` has their seconds. Iterations are those of the schedule, which
    are those of the run if it is `steady`. iterations: the last one; always: those that score all views, as the last
    one does; those between score a fixed part of each set (`curve_points`, `drawn`), from which the whole is estimated
    (`Estimates`); with whole_test, test views alone (`whole_points`), unless all fit. A run that is not steady has no
    points between until it is known how many iterations it takes. views: those to score, by set, "test" and "train".
    load(views) decodes their photos; scores(view) gives the scores of one by name, none if no pixel
    counts. If the file cannot be written, one warning says so and the next point tries again: a training is worth more
    than its curve.
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
        whole_test: bool = False,
    ) -> None:
        self.rows = rows
        self._folder = Path(model_path)
        self._log = log
        self._iterations = iterations
        self._whole = {*always, iterations}
        self._views, self._steady, self._whole_test = views, steady, whole_test
        self._counts: dict[str, dict[int, int]] = {}  # of views to score, by set and iteration
        self._planned = 0.0  # for so many iterations
        self._points, self._size = {*self._whole}, None
        if steady:
            self._plan(iterations)
        self._estimates = Estimates(rows, views)
        self._load = load
        self._scores = scores
        self._device = device
        self._scored = 0
        self._spent = dict.fromkeys(("scoring", "writing", "drawing", "loading"), 0.0)  # seconds
        self._warned = False
        self._drawer = CurveDrawer(self._folder, {name: len(of_set) for name, of_set in views.items()})
        self._ahead = AHEAD if cores() >= MANY_CORES else 0.0

    def _plan(self, taken: float) -> None:
        """Choose points, and how many views they score, for a run that takes so many iterations."""
        self._planned = taken
        views, most = self._views, max(map(len, self._views.values()))
        given = self._iterations, self._whole, len(views)
        between, size = curve_points(*given, most, taken if not self._steady else None)
        self._counts = {name: dict.fromkeys(between, size) for name in views}
        if self._whole_test and size < most:
            self._counts = {"test": whole_points(*given, len(views["test"]), taken)}
        elif len(views) * len(between) * VIEW_COST > MOST_SHARE * taken:
            self._counts = {"test": dict.fromkeys(between, size)}
        self._points = self._whole | self._counts["test"].keys()
        self._size = min((n for n in self._counts["test"].values() if n < len(views["test"])), default=None)

    def point(self, span: range) -> int | None:
        """The iteration to score of those that a step stands for; None: none of them."""
        return max(self._points.intersection(span), default=None)

    def due(self, span: range, first: int, seconds: float, taken: float | None = None) -> bool:
        """Whether to `add` a point in the step of a span; if so, it waits for the GPU.

        seconds: of training since iteration `first`. taken: the number of iterations of a run that is not steady, as
        far as it is known. Shortly before the end it gets ready to draw.
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
        """Score after `seconds` of training in this run, and write the curve with the new point.

        With the last one, it is being drawn from then on until `finish`. trained: iteration of the run, where that is
        another one.
        """
        # The peaks of log and curve, because after a rescue the curve has rows beyond the log's last record.
        peaks = [self._log.peak_memory_mib(), *(row["peak_memory_mib"] for row in self.rows[-1:])]
        views = self._views
        if iteration not in self._whole:
            views = {name: drawn(views[name], counts[iteration]) for name, counts in self._counts.items()}
        part = len(views["test"]) < len(self._views["test"])
        row = dict.fromkeys(COLUMNS) | {
            "iteration": iteration if trained is None else trained,
            "seconds": round(self._log.seconds_before + seconds, 3),
            "wall_seconds": round(self._log.wall_seconds_before + wall_seconds(), 3),
            "gaussians": gaussians,
            "peak_memory_mib": max((peak for peak in peaks if peak is not None), default=None),
            SUBSET: len(views["test"]) if part else None,
        }
        if not self._scored:  # photos that training mostly needs soon: no part of the cost
            self._timed("loading", lambda: self._load([view for of_set in self._views.values() for view in of_set]))
        self._timed("scoring", lambda: self._score(row, views))
        self._scored += 1
        self.rows.append(row)
        self._timed("writing", self._write)
        if iteration == self._iterations and writes_files():
            self._drawer.draw()

    def _timed(self, part: str, call: Callable[[], object]) -> None:
        start = running_seconds()
        call()
        self._spent[part] += running_seconds() - start

    def _score(self, row: Row, views: dict[str, Sequence[View]]) -> None:
        scores: dict[str, list[float]] = {}
        for name, of_set in views.items():
            for view in of_set:
                for score, value in self._scores(view).items():
                    scores.setdefault(f"{name}_{score}", []).append(value)
        row |= {name: round(fmean(values), 6) for name, values in scores.items()}
        self._estimates.add(row, scores)

    def _write(self) -> None:
        try:
            write_curve(self._folder / NAME, self.rows)
        except UserError as error:
            if not self._warned:
                tqdm.write(f"warning: {error}; training continues without its curve", file=sys.stderr)
            self._warned = True

    def finish(self, seconds: float, saved: Container[int], steady: bool) -> None:
        """Wait for the figure, say where it is, and give `peak_advice`.

        seconds: of training in this run. The log's last record gets the costs: `curve_scoring_seconds`,
        `curve_writing_seconds` (of the file), `curve_drawing_seconds` (of waiting), and `curve_loading_seconds` (of
        photos, before the first scoring).
        """
        if writes_files():
            self._timed("drawing", self._draw)
        costs = {f"curve_{part}_seconds": round(taken, 4) for part, taken in self._spent.items()}
        self._log.add(self.rows[-1]["iteration"], seconds, **costs)
        often = "once" if self._scored == 1 else f"{self._scored} times"
        sizes = sorted(row[SUBSET] for row in self.rows[-self._scored :] if row[SUBSET] is not None)
        if sizes:
            some = f"{sizes[0]}" if sizes[0] == sizes[-1] else f"{sizes[0]} to {sizes[-1]}"
            often += f" ({len(sizes)} of them on {some} of {len(self._views['test'])} views)"
        self._log.tell(f"Test PSNR measured {often}, {self._spent['scoring']:.1f} s: {self._folder / FIGURE}")
        if advice := peak_advice(self.rows, saved, steady):
            # Where training overfits, `what_to_try` says more, and one line is printed.
            (self._log.keep if gain_since_peak(self.rows) else self._log.advise)(advice)

    def _draw(self) -> None:
        if failure := self._drawer.finish():
            print(f"warning: no {FIGURE}: {failure}", file=sys.stderr)

    def abandon(self) -> None:
        """Draw nothing: the training did not reach its end."""
        self._drawer.abandon()
