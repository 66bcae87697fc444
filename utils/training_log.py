"""train_log.json: error against run time, one record per tested or saved iteration and checkpoint."""

import json
import math
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from utils.process import wall_seconds
from utils.system_utils import atomic_write

NAME = "train_log.json"


class Stopwatch:
    """Seconds since it was made, without what happens inside `paused()`."""

    def __init__(self) -> None:
        self._start = time.perf_counter()

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._start

    @contextmanager
    def paused(self) -> Iterator[None]:
        before = time.perf_counter()
        try:
            yield
        finally:
            self._start += time.perf_counter() - before


class TrainingLog:
    """Records of one model folder, written whole after each addition.

    A record has `iteration`, `seconds` (of training, without evaluation and saving; a resumed run adds to the seconds
    before), `wall_seconds` (since the start of the process, likewise), `gaussians`, `loss` (running mean), and per set
    tested `<set>_l1`, `<set>_psnr`; the last record also `gaussians_left_out`, those of `gaussians` that the last save
    does not have, and what the curve has cost (`utils.curve_recorder`).

    first_iteration, seconds_before, wall_seconds_before: what the runs have done that this one goes on from.
    """

    def __init__(self, model_path: str | os.PathLike, first_iteration: int) -> None:
        """Keep an existing log's records up to `first_iteration`, which a resumed run goes on from."""
        self._path = Path(model_path) / NAME
        self.first_iteration = first_iteration
        self.records: list[dict] = []
        if first_iteration > 0 and self._path.is_file():
            self.records = [r for r in _read(self._path) if r["iteration"] <= first_iteration]
        last = self.records[-1] if self.records else {"seconds": 0.0}
        self.seconds_before = last["seconds"]
        self.wall_seconds_before = last.get("wall_seconds") or last["seconds"]

    @property
    def loss(self) -> float:
        """Running mean of the last record, 0 where there is none."""
        return (self.records[-1].get("loss") if self.records else None) or 0.0

    def add(self, iteration: int, seconds: float, **values: float) -> None:
        """Append a record, or add to that of the same iteration.

        A value that is not finite (PSNR of equal images) becomes null.
        """
        record = {name: value if math.isfinite(value) else None for name, value in values.items()}
        record |= {
            "iteration": iteration,
            "seconds": round(self.seconds_before + seconds, 3),
            "wall_seconds": round(self.wall_seconds_before + wall_seconds(), 3),
        }
        if self.records and self.records[-1]["iteration"] == iteration:
            record = self.records.pop() | record
        self.records.append(record)
        with atomic_write(self._path) as temporary:
            temporary.write_text(json.dumps(self.records, indent=1, sort_keys=True, allow_nan=False) + "\n")


def _read(path: Path) -> list[dict]:
    """Records of a log; none, with a warning, where the file is damaged: it is no reason to stop a training."""
    try:
        records = json.loads(path.read_text(encoding="utf-8"))
        if not all(isinstance(r["iteration"], int) and math.isfinite(r["seconds"]) for r in records):
            raise ValueError
        if not all(math.isfinite(r.get(name) or 0.0) for r in records for name in ("loss", "wall_seconds")):
            raise ValueError
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        print(f"warning: {path} cannot be read as a training log; a new one is started", file=sys.stderr)
        return []
    return records
