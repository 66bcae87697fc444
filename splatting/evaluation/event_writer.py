"""TensorBoard's writer, imported when it is first needed, whose errors do not end a training."""

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

from tqdm import tqdm

_FLUSHED = 10  # seconds until events are in the file at the latest


class EventWriter:
    """A SummaryWriter of torch, all of whose methods can be called. ImportError without TensorBoard.

    If one fails, as on a full disk, one warning says so, and nothing more is written.
    """

    def __init__(self, log_dir: str) -> None:
        from torch.utils.tensorboard import SummaryWriter  # takes 0.3 s to import

        self._folder, self._failed = log_dir, False
        self._writer = self._guarded(SummaryWriter, log_dir, flush_secs=_FLUSHED)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("_"):
            raise AttributeError(name)
        return partial(self._guarded, getattr(self._writer, name, None))

    def _guarded(self, method: Callable[..., Any], *given: Any, **named: Any) -> Any:
        if self._failed:
            return None
        try:
            return method(*given, **named)
        except Exception as error:  # whatever it is, the training goes on
            self._failed = True
            fault = f"cannot write TensorBoard's events into {self._folder} ({error})"
            tqdm.write(f"warning: {fault}; training continues without them", file=sys.stderr)
            return None
