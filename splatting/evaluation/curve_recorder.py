"""Recorder of a model's error against its run time of training; it changes no bit of the model."""

import contextlib
import random
import subprocess
import sys
from collections.abc import Callable, Container, Iterable, Sequence
from pathlib import Path
from typing import TypeVar

import torch
from tqdm import tqdm

from splatting.evaluation.error_curve import COLUMNS, FIGURE, NAME, SUBSET, Row, write_curve
from splatting.evaluation.training_log import SHORT, TrainingLog
from splatting.evaluation.what_to_try import peak_advice
from splatting.host.clock import running_seconds, wall_seconds
from splatting.host.interrupt import own_session
from splatting.host.machine import cores
from utils.system_utils import UserError, writes_files

AHEAD, MANY_CORES = 2.0, 4  # seconds before the end at which drawing gets ready, where that takes no core from training
SHORTEST = 200  # iterations of a training that is scored between, too
GRIDS = ((4, 32), (2, 12))  # points while the number of iterations doubles, and their number before the last iteration
SHARE = 0.025  # of a training that scoring may take by its estimate; 0.05 is promised, and early points may be dearer
VIEW_COST = 0.5  # of scoring a view, in iterations: it takes no gradient and no step
_ROOT = Path(__file__).resolve().parents[2]
View = TypeVar("View")


def curve_points(
    iterations: int, whole: Iterable[int], sets: int, views: int, steady: bool = True
) -> tuple[frozenset[int], int]:
    """The iterations that a curve scores between those of `whole`, which score all views; and how many views of a set.

    The points are evenly spaced in the logarithm of the iteration, and follow from the options alone, so that the same
    command scores the same on every machine. They score as many views as fit SHARE of the training, at least one, on
    the coarse grid; all views on the fine one where that fits, too. sets: of `views` each. steady: whether each
    iteration of the schedule is one of the training; if not, the fine grid could take too long.
    """
    if iterations < SHORTEST:
        return frozenset(), 1
    whole = {t for t in whole if 0 < t < iterations} | {iterations}
    budget = SHARE * iterations / VIEW_COST - len(whole) * sets * views
    (fine, many), coarse = GRIDS
    density, count = (fine, many) if steady and budget >= sets * views * many else coarse
    places = {round(iterations * 2 ** (-place / density)) for place in range(1, count + 1)}
    return frozenset(places - whole), max(1, min(views, int(budget / (sets * count))))


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

    `begin`, `draw`, `finish` in that order; `abandon` at any time.
    """

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
                [sys.executable, "-X", "utf8", "-m", "splatting.evaluation.figures", *files, self._folder.name],
                cwd=_ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, encoding="utf-8",
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
    """Scores views in the iterations of a plan, keeps the curve's file up to date, and draws it at the end.

    rows: those of the runs that this one resumes; `log` has their seconds. Iterations are those of the schedule, which
    are those of the run if it is `steady`. iterations: the last one; always: those that score all views, as the last
    one does; those between score a fixed part of each set (`curve_points`, `drawn`). views: those to score, by set,
    "test" and "train". load(views) decodes their photos; scores(views) gives their mean scores by name. If the file
    cannot be written, one warning says so and the next point tries again: a training is worth more than its curve.
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
        scores: Callable[[Sequence[View]], dict[str, float]],
        device: torch.device,
        steady: bool = True,
    ) -> None:
        self.rows = rows
        self._folder = Path(model_path)
        self._log = log
        self._iterations = iterations
        self._whole = {*always, iterations}
        most = max(map(len, views.values()))
        between, size = curve_points(iterations, always, len(views), most, steady)
        self._points = self._whole | between
        self._size = size if size < most else None
        self._views, self._part = views, {name: drawn(of_set, size) for name, of_set in views.items()}
        self._load = load
        self._scores = scores
        self._device = device
        self._scored = 0
        self._spent = dict.fromkeys(("scoring", "writing", "drawing", "loading"), 0.0)  # seconds
        self._warned = False
        self._drawer = CurveDrawer(self._folder)
        self._ahead = AHEAD if cores() >= MANY_CORES else 0.0

    def point(self, span: range) -> int | None:
        """The iteration to score of those that a step stands for; None: none of them."""
        return max(self._points.intersection(span), default=None)

    def due(self, span: range, first: int, seconds: float) -> bool:
        """Whether to `add` a point in the step of a span; if so, it waits for the GPU.

        seconds: of training since iteration `first`. Shortly before the end it gets ready to draw.
        """
        if not span:
            return False
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
        views, size = (self._part, self._size) if iteration not in self._whole else (self._views, None)
        row = dict.fromkeys(COLUMNS) | {
            "iteration": iteration if trained is None else trained,
            "seconds": round(self._log.seconds_before + seconds, 3),
            "wall_seconds": round(self._log.wall_seconds_before + wall_seconds(), 3),
            "gaussians": gaussians,
            "peak_memory_mib": max((peak for peak in peaks if peak is not None), default=None),
            SUBSET: size,
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
        for name, of_set in views.items():
            row |= {f"{name}_{score}": round(value, 6) for score, value in self._scores(of_set).items()}

    def _write(self) -> None:
        try:
            write_curve(self._folder / NAME, self.rows)
        except UserError as error:
            if not self._warned:
                tqdm.write(f"warning: {error}; training continues without its curve", file=sys.stderr)
            self._warned = True

    def finish(
        self, seconds: float, saved: Container[int], position_lr_max_steps: int | None, follows_length: bool
    ) -> None:
        """Wait for the figure, print the curve's cost beside `seconds` of training in this run, and give `peak_advice`.

        The log's last record gets the costs: `curve_scoring_seconds`, `curve_writing_seconds` (of the file),
        `curve_drawing_seconds` (of waiting), and `curve_loading_seconds` (of photos, before the first scoring).
        """
        if writes_files():
            self._timed("drawing", self._draw)
        costs = {f"curve_{part}_seconds": round(taken, 4) for part, taken in self._spent.items()}
        self._log.add(self.rows[-1]["iteration"], seconds, **costs)
        self._log.tell(self._costs(seconds))
        if advice := peak_advice(self.rows, saved, position_lr_max_steps, follows_length):
            self._log.tell(advice)

    def _draw(self) -> None:
        if failure := self._drawer.finish():
            print(f"warning: no {FIGURE}: {failure}", file=sys.stderr)

    def _costs(self, seconds: float) -> str:
        scoring, writing, drawing, _ = self._spent.values()
        share = f"{100 * scoring / seconds:.1f} % of the training"
        if self._iterations <= SHORT:
            return f"Curve of {len(self.rows)} points, scored in {scoring:.2f} s ({share})"
        between = "" if self._size is None else f", {self._size} of each set between --test_iterations"
        return (
            f"Scored {sum(map(len, self._views.values()))} views at {self._scored} iterations{between}, "
            f"in {scoring:.2f} s ({share}), wrote {NAME} in {writing:.3f} s ({100 * writing / seconds:.2f} %), "
            f"drew it in {drawing:.1f} s"
        )

    def abandon(self) -> None:
        """Draw nothing: the training did not reach its end."""
        self._drawer.abandon()
