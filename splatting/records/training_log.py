"""Records of a training in train_log.json, by a clock of training; a record for each tested or saved iteration."""

import math
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from groundwork.files.json_files import read_json, write_json
from groundwork.host.clock import running_seconds, tick, wall_seconds
from groundwork.host.memory import peak_memory_mib
from utils.system_utils import UserError, compute_device

NAME = "train_log.json"
SHORT = 2000  # iterations; after trainings up to this length, what training says at its end is short
DEGREES, PERCENT = "pose_degrees", "pose_percent"  # mean correction of refined poses: turn, and part of the extent
_OTHERS = "loss", "joules", "peak_memory_mib", "wall_seconds"
_FINITE = (DEGREES, PERCENT, *_OTHERS)  # if present


class Stopwatch:
    """A clock of the seconds since its construction, stopped inside `paused()` and while the process is stopped.

    counter: function that reads joules (host/energy.py), which are counted like the seconds, but also while the process
        is stopped. It is called inside of pauses, so that it costs no seconds. None: no joules are known.
    spent: seconds inside of pauses, by their purpose. A pause inside another one counts for the inner purpose.
    """

    def __init__(self, counter: Callable[[], float] | None = None) -> None:
        """Start the clock."""
        self._counter = counter or (lambda: math.nan)
        self._joules = self._counter()  # at the start, later without those of pauses
        self._joules_stopped = math.nan
        tick(self)
        self._start = running_seconds()
        self._stopped: float | None = None  # when the outermost pause began
        self.spent: dict[str, float] = {}

    @property
    def seconds(self) -> float:
        return (running_seconds() if self._stopped is None else self._stopped) - self._start

    @property
    def joules(self) -> float | None:
        """Joules in the seconds of the clock; None if they are not known."""
        joules = (self._counter() if self._stopped is None else self._joules_stopped) - self._joules
        return None if math.isnan(joules) else joules

    @contextmanager
    def paused(self, purpose: str) -> Iterator[None]:
        """Stop the clock inside of a `with` block, and add its seconds to `spent[purpose]`."""
        before, outer, others = running_seconds(), self._stopped, sum(self.spent.values())
        self._stopped = before if outer is None else outer
        if outer is None:
            self._joules_stopped = self._counter()
        try:
            yield
        finally:
            if outer is None:
                self._joules += self._counter() - self._joules_stopped
            taken = running_seconds() - before
            inner = sum(self.spent.values()) - others
            self.spent[purpose] = self.spent.get(purpose, 0.0) + taken - inner
            self._stopped = outer
            if outer is None:
                self._start += taken


class TrainingLog:
    """The records of a model folder, written whole after each addition. Entries of a record:

    iteration: number of the iteration.
    seconds: seconds of training, without evaluation, saving and a stopped process.
    wall_seconds: seconds since the process started.
    joules: joules of all GPUs in the seconds of training, where known.
    peak_memory_mib: the most memory so far.
    gaussians: number of Gaussians.
    loss: a running mean.
    `<set>_l1`, `<set>_psnr`: scores of each set tested.

    Seconds, joules and memory include the runs that were resumed. The last record also has `gaussians_left_out` (those
    that the last save does not have), the costs of the curve (curve_recorder.py), the seconds of this process by their
    purpose (splatting/log.py), `strategy`, and `lines`, which were printed at the end.

    first_iteration, seconds_before, wall_seconds_before: done by the runs that this one resumes.
    """

    def __init__(
        self, model_path: str | os.PathLike, first_iteration: int = 0, before: str | os.PathLike | None = None
    ) -> None:
        """Keep the records of an existing log up to `first_iteration`, where a run resumes.

        before: folder of that log, unless it is model_path.
        """
        self._path = Path(model_path) / NAME
        source = self._path if before is None else Path(before) / NAME
        self.first_iteration = first_iteration
        self.records: list[dict] = []
        self._advised = False
        if first_iteration > 0 and source.is_file():
            self.records = [r for r in _read_or_warn(source) if r["iteration"] <= first_iteration]
        last = self.records[-1] if self.records else {"seconds": 0.0}
        self.seconds_before = last["seconds"]
        self.wall_seconds_before = last.get("wall_seconds") or last["seconds"]
        self._joules_before: float | None = last.get("joules") if self.records else 0.0
        self._peak_before: float | None = last.get("peak_memory_mib")

    def not_before(self, row: dict[str, float | None]) -> None:
        """Continue counting from a row of the earlier runs' curve, if it is later than the log of these runs.

        The row has no joules, so those of this training are not known then.
        """
        if row["seconds"] > self.seconds_before:
            self._joules_before = None
        self.seconds_before = max(self.seconds_before, row["seconds"])
        self.wall_seconds_before = max(self.wall_seconds_before, row["wall_seconds"] or 0.0)

    @property
    def loss(self) -> float:
        """The running mean of the last record, 0 if there is none."""
        return (self.records[-1].get("loss") if self.records else None) or 0.0

    def peak_memory_mib(self) -> float | None:
        """Return the most memory held so far, by this run or those it resumes (host/memory.py); None if not known."""
        peaks = [peak for peak in (self._peak_before, peak_memory_mib(compute_device())) if peak is not None]
        return round(max(peaks), 1) if peaks else None

    def add(self, iteration: int, seconds: float, joules: float | None = None, **values: float) -> None:
        """Append a record, or add to that of the same iteration.

        A value that is not finite (PSNR of equal images) becomes null.

        seconds, joules: of this run.
        """
        record = {name: value if math.isfinite(value) else None for name, value in values.items()}
        record |= {
            "iteration": iteration,
            "peak_memory_mib": self.peak_memory_mib(),
            "seconds": round(self.seconds_before + seconds, 3),
            "wall_seconds": round(self.wall_seconds_before + wall_seconds(), 3),
        }
        if joules is not None and self._joules_before is not None:
            record["joules"] = round(self._joules_before + joules, 1)
        if self.records and self.records[-1]["iteration"] == iteration:
            before = self.records.pop()
            record = before | record | {"seconds": max(before["seconds"], record["seconds"])}
        self.records.append(record)
        write_json(self._path, self.records)

    def note(self, **values: float | None) -> None:
        """Add values to the last record, and change nothing else in it."""
        if self.records:
            self.records[-1] |= values
            write_json(self._path, self.records)

    def tell(self, *lines: str) -> None:
        """Print lines about the finished training, and `keep` them."""
        print(*lines, sep="\n")
        self.keep(*lines)

    def advise(self, *lines: str) -> None:
        """Keep lines that say what to try next (`keep`), and print the first line of a training."""
        if lines and not self._advised:
            self._advised = True
            print(lines[0])
        self.keep(*lines)

    def keep(self, *lines: str) -> None:
        """Add lines to `lines` of the last record, which reports show."""
        if self.records and lines:
            self.records[-1].setdefault("lines", []).extend(lines)
            write_json(self._path, self.records)


def read_log(path: str | os.PathLike) -> list[dict]:
    """Read the records of a log; none if there is no file. UserError if the file is damaged."""
    if not Path(path).is_file():
        return []
    try:
        records = read_json(Path(path))
        if not all(isinstance(r["iteration"], int) and math.isfinite(r["seconds"]) for r in records):
            raise ValueError
        if not all(math.isfinite(r.get(name) or 0.0) for r in records for name in _FINITE):
            raise ValueError
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise UserError(f"{path} cannot be read as a training log; train again to record one") from error
    return records


def _read_or_warn(path: Path) -> list[dict]:
    """Read the records of a log; none, with a warning, if the file is damaged: that is no reason to stop a training."""
    try:
        return read_log(path)
    except UserError as error:
        print(f"warning: {str(error).partition('; ')[0]}; a new one is started", file=sys.stderr)
        return []
