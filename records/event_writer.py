"""The part of TensorBoard's SummaryWriter that training needs, without TensorBoard's import and beside the training."""

import importlib.util
import itertools
import socket
import sys
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from os import getpid
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from records import event_file

_PAUSE = 0.05  # seconds from a record until it is made
_NUMBERS = itertools.count()  # of the files of this process


def tensorboard_is_installed() -> bool:
    """Whether somebody can read the events here. Nothing is imported."""
    return importlib.util.find_spec("tensorboard") is not None


class EventWriter:
    """Writes scalars, images and histograms into a new event file of a folder, in a thread of its own.

    TensorBoard's own writer takes a second to import, encodes images while training waits, and computes checksums byte
    by byte in Python. Everything else that it can do is done by one of its kind, made when first asked for. If the file
    cannot be written, one warning says so: a training is worth more than its events.
    """

    def __init__(self, log_dir: str) -> None:
        self._folder = log_dir
        name = f"events.out.tfevents.{int(time.time()):010d}.{socket.gethostname()}.{getpid()}.{next(_NUMBERS)}"
        self._path = Path(log_dir) / name
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="events")
        self._complete: Any = None
        self._failed = False
        self._records: deque[Callable[[], bytes]] = deque()
        self._is_told = False  # the thread, that there are records
        self._hurry = Event()
        self._write(lambda: event_file.first_record(time.time()))

    def add_scalar(
        self, tag: str, scalar_value: float, global_step: int | None = None, *more: Any, **most: Any
    ) -> None:
        """Write a number."""
        if more or most:
            return self._others().add_scalar(tag, scalar_value, global_step, *more, **most)
        wall, number = time.time(), float(scalar_value)
        self._write(lambda: event_file.value_record(wall, global_step, event_file.scalar(tag, number)))

    def add_image(self, tag: str, img_tensor: Tensor, global_step: int | None = None, *more: Any, **most: Any) -> None:
        """Write an image (3, H, W), float in [0, 1], as a PNG of 8 bits."""
        if more or most or not _is_float(img_tensor) or img_tensor.shape[0] != 3 or img_tensor.dim() != 3:
            return self._others().add_image(tag, img_tensor, global_step, *more, **most)
        wall = time.time()
        pixels = (img_tensor.detach() * 255).clamp(0, 255).to(torch.uint8).permute(1, 2, 0).contiguous().cpu().numpy()
        self._write(lambda: event_file.value_record(wall, global_step, event_file.image(tag, pixels)))

    def add_histogram(self, tag: str, values: Tensor, global_step: int | None = None, *more: Any, **most: Any) -> None:
        """Write the histogram of the values that are finite, if there are any."""
        if more or most or not _is_float(values):
            return self._others().add_histogram(tag, values, global_step, *more, **most)
        wall, numbers = time.time(), values.detach().to("cpu", torch.float32, copy=True).numpy()

        def record() -> bytes:
            finite = numbers[np.isfinite(numbers)]
            return event_file.value_record(wall, global_step, event_file.histogram(tag, finite)) if finite.size else b""

        self._write(record)

    def flush(self) -> None:
        """Return when everything so far is written."""
        self._hurry.set()
        self._thread.submit(self._hurry.clear).result()
        if self._complete is not None:
            self._complete.flush()

    def close(self) -> None:
        """Write everything so far; nothing may be added afterwards."""
        self._hurry.set()
        self._thread.shutdown()
        if self._complete is not None:
            self._complete.close()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self._others(), name)

    def _others(self) -> Any:
        """TensorBoard's own writer, for what this one does not know."""
        if self._complete is None:
            from torch.utils.tensorboard import SummaryWriter

            self._complete = SummaryWriter(self._folder)
        return self._complete

    def _write(self, record: Callable[[], bytes]) -> None:
        """Append a record, which the thread makes."""
        self._records.append(record)
        if not self._is_told:
            self._is_told = True
            self._thread.submit(self._append)

    def _append(self) -> None:
        # Records come in bursts, while training waits: its thread would have to share the interpreter with this one.
        self._hurry.wait(_PAUSE)
        self._is_told = False  # before the records are taken, so that none is left behind
        records = [self._records.popleft() for _ in range(len(self._records))]
        if self._failed:
            return
        try:
            with self._path.open("ab") as file:
                file.writelines(record() for record in records)
        except Exception as error:  # whatever it is, the training goes on
            self._failed = True
            message = f"warning: cannot write {self._path} ({error}); training continues without TensorBoard's events"
            tqdm.write(message, file=sys.stderr)


def _is_float(values: Any) -> bool:
    return torch.is_tensor(values) and values.is_floating_point()
