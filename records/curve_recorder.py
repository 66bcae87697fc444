"""Recorder of a model's error against its run time of training; it changes no bit of the model."""

import random
import sys
from collections.abc import Callable, Container, Sequence
from pathlib import Path
from typing import TypeVar

import torch
from tqdm import tqdm

from records.curve_drawer import CurveDrawer
from records.curve_peak import peak_advice
from records.curve_schedule import CurveSchedule, subset_size
from records.error_curve import COLUMNS, FIGURE, NAME, SUBSET, Row, write_curve
from records.training_log import SHORT, TrainingLog
from utils.host.process import wall_seconds
from utils.host.running import running_seconds
from utils.host.threads import cores
from utils.ranks.ranks import ranks
from utils.system_utils import UserError

AHEAD, MANY_CORES = 2.0, 4  # seconds before the end at which drawing gets ready, where that takes no core from training
View = TypeVar("View")


def evenly_spread(views: Sequence[View], count: int) -> list[View]:
    """`count` of the views, or all if there are fewer; with two or more, the first and the last are among them."""
    count = min(count, len(views))
    return [views[round(index * (len(views) - 1) / max(count - 1, 1))] for index in range(count)]


def drawn(views: Sequence[View], count: int) -> list[View]:
    """`count` of the views, drawn with a fixed seed and in their order. A larger count has those of a smaller one."""
    indices = list(range(len(views)))
    random.Random(0).shuffle(indices)
    return [views[index] for index in sorted(indices[:count])]


class CurveRecorder:
    """Scores views in the iterations of a schedule, keeps the curve's file up to date, and draws it at the end.

    rows: those of the runs that this one resumes; `log` has their seconds. Iterations are those of the schedule, which
    are those of the run unless `add` says otherwise. first: done already. iterations: the last one; always: those
    that score all views, as the last one does; the others score a fixed part of each set (`subset_size`, `drawn`).
    views: those to score, by set, "test" and "train". load(views) decodes their photos; scores(views) gives their mean
    scores by name. If the file cannot be written, one warning says so and the next point
    tries again: a training is worth more than its curve.
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
        first: int | None = None,
    ) -> None:
        self.rows = rows
        self._folder = Path(model_path)
        self._log = log
        tested = len({t for t in always if 0 < t < iterations}) + 1
        most = max(map(len, views.values()))
        size = subset_size(iterations, tested, len(views), most)
        self._views, self._subset = views, {name: drawn(of_set, size) for name, of_set in views.items()}
        self._size = size if size < most else None
        self._count, count = (sum(map(len, sets.values())) for sets in (self._views, self._subset))
        self._first = log.first_iteration if first is None else first
        self._schedule = CurveSchedule(self._first, iterations, always, self._count, count)
        self._iterations = iterations
        self._load = load
        self._scores = scores
        self._device = device
        self._loading = 0.0  # seconds of decoding photos that were not needed before
        self._writing = 0.0  # seconds of writing the file
        self._warned = False
        self._drawer = CurveDrawer()
        self._ahead = AHEAD if cores() >= MANY_CORES else 0.0

    def is_point(self, iteration: int) -> bool:
        """Whether an iteration may be scored."""
        return self._schedule.has(iteration)

    def due(self, iteration: int, seconds: float) -> bool:
        """Whether to `add` a point after `seconds` of training in this run; if so, it waits for the GPU."""
        pace = seconds / max(iteration - self._first, 1)
        if ranks().first and pace * (self._iterations - iteration) <= self._ahead:
            self._drawer.begin()
        due = self._schedule.due(iteration, seconds)
        if self.is_point(iteration):
            due = ranks().shared(due)  # it follows from the clock
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
        row = dict.fromkeys(COLUMNS) | {
            "iteration": iteration if trained is None else trained,
            "seconds": round(self._log.seconds_before + seconds, 3),
            "wall_seconds": round(self._log.wall_seconds_before + wall_seconds(), 3),
            "gaussians": gaussians,
            "peak_memory_mib": max((peak for peak in peaks if peak is not None), default=None),
            SUBSET: None if self._schedule.whole(iteration) else self._size,
        }
        if not self._schedule.scorings:
            # Happens once, mostly for photos that training needs soon: no measure of the next scoring's cost.
            self._loading = self._seconds(self._load_all)
        views = self._views if row[SUBSET] is None else self._subset
        self._schedule.scored(iteration, self._seconds(lambda: self._score(row, views)))
        self.rows.append(row)
        self._writing += self._seconds(self._write)
        if iteration == self._iterations:
            self._drawer.draw(self._folder / FIGURE, self.rows, self._folder.resolve().name)

    @staticmethod
    def _seconds(call: Callable[[], object]) -> float:
        start = running_seconds()
        call()
        return running_seconds() - start

    def _load_all(self) -> None:
        self._load([view for of_set in self._views.values() for view in of_set])

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
        drawing = self._seconds(self._draw)
        scoring, writing = self._schedule.spent, self._writing
        self._log.add(
            self.rows[-1]["iteration"],
            seconds,
            curve_scoring_seconds=round(scoring, 3),
            curve_writing_seconds=round(writing, 4),
            curve_drawing_seconds=round(drawing, 3),
            curve_loading_seconds=round(self._loading, 3),
        )
        self._log.tell(self._costs(scoring, writing, drawing, seconds))
        if advice := peak_advice(self.rows, saved, position_lr_max_steps, follows_length):
            self._log.tell(advice)

    def _costs(self, scoring: float, writing: float, drawing: float, seconds: float) -> str:
        share = f"{100 * scoring / seconds:.1f} % of the training"
        if self._iterations <= SHORT:
            return f"Curve of {len(self.rows)} points, scored in {scoring:.2f} s ({share})"
        between = "" if self._size is None else f", {self._size} of each set between --test_iterations"
        return (
            f"Scored {self._count} views at {self._schedule.scorings} iterations{between}, "
            f"in {scoring:.2f} s ({share}), wrote {NAME} in {writing:.3f} s ({100 * writing / seconds:.2f} %), "
            f"drew it in {drawing:.1f} s"
        )

    def abandon(self) -> None:
        """Draw nothing: the training did not reach its end."""
        self._drawer.abandon()

    def _draw(self) -> None:
        if ranks().first and (failure := self._drawer.finish()):
            print(f"warning: no {FIGURE}: {failure}", file=sys.stderr)
