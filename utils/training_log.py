"""train_log.json: error against run time, one record per tested or saved iteration."""

import json
import math
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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
        yield
        self._start += time.perf_counter() - before


class TrainingLog:
    """Records of one model folder, written whole after each addition.

    A record has `iteration`, `seconds` (of training, without evaluation and saving; a resumed run adds to the seconds
    before), `gaussians`, `loss` (running mean), and per set tested `<set>_l1`, `<set>_psnr`.
    """

    def __init__(self, model_path: str | os.PathLike, first_iteration: int) -> None:
        """Keep an existing log's records up to `first_iteration`, which a resumed run goes on from."""
        self._path = Path(model_path) / NAME
        self.records: list[dict] = []
        if first_iteration > 0 and self._path.is_file():
            self.records = [r for r in json.loads(self._path.read_text()) if r["iteration"] <= first_iteration]
        self._seconds_before = self.records[-1]["seconds"] if self.records else 0.0

    def add(self, iteration: int, seconds: float, **values: float) -> None:
        """Append a record; a value that is not finite (PSNR of equal images) becomes null."""
        record = {name: value if math.isfinite(value) else None for name, value in values.items()}
        record |= {"iteration": iteration, "seconds": round(self._seconds_before + seconds, 3)}
        self.records.append(record)
        with atomic_write(self._path) as temporary:
            temporary.write_text(json.dumps(self.records, indent=1, sort_keys=True, allow_nan=False) + "\n")
