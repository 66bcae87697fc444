"""Ranks whose collective calls are watched, so that one that fails or never returns ends in a sentence."""

import contextlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from functools import wraps
from typing import Any

import torch
import torch.distributed as dist

from splatting.distributed import rank_logging
from splatting.distributed.process_group import SeveralRanks
from splatting.host.clock import running_seconds
from splatting.host.memory import is_out_of_memory

# Of a collective call. It has to be longer than any work of one rank that the others wait for, as rank 0 writing tens
# of gigabytes to a slow disk. A rank that is gone or hangs is noticed by other means and within seconds (watchdog.py).
TIMEOUT = timedelta(minutes=30)
# Of gloo's errors for a rank that cannot be reached, and of torch's for a store.
_WORDS = ("closed by peer", "reset by peer", "broken pipe", "timed out", "timeout", "connect", "read error", "socket")


class RankLost(Exception):
    """A collective call failed because of another rank; that one, or whoever misses it, says what happened."""


def _watched(call: Callable[..., Any]) -> Callable[..., Any]:
    """Note that a rank waits in a collective call, and turn the loss of another rank into RankLost."""

    @wraps(call)
    def wrapped(self: "WatchedRanks", *args: Any, **named: Any) -> Any:
        if self._called is not None:  # one call in another
            return call(self, *args, **named)
        self.calls += 1
        self._called = running_seconds()
        try:
            result = call(self, *args, **named)
            self._note_queued()
            return result
        except RuntimeError as error:
            lost = isinstance(error, dist.DistError) or any(words in str(error).lower() for words in _WORDS)
            if is_out_of_memory(error) or not lost:
                raise
            raise RankLost(str(error)) from error
        finally:
            if self.prompt:
                self.longest = max(self.longest, running_seconds() - self._called)
            self._called = None

    return wrapped


class WatchedRanks(SeveralRanks):
    """The ranks of a training that torchrun has started.

    calls: collective calls so far, the same number on all ranks that are in the same call. longest: seconds that one
    took while `prompt`. stands: says what is left of the training if a rank is lost, and how to go on.
    """

    def __init__(self) -> None:
        super().__init__()
        self.calls = 0
        self._called: float | None = None  # when the running call began
        self._queued: tuple[torch.cuda.Event, float] | None = None  # the end of the last one on a GPU, and its begin
        self.longest = 0.0
        self._at_work = 0
        self.stands: Callable[[], str] = lambda: "start it again"

    @contextmanager
    def busy(self) -> Iterator[None]:
        self._at_work += 1
        try:
            yield
        finally:
            self._at_work -= 1

    @property
    def expected(self) -> bool:
        """Whether the others may expect this rank at the next collective call within seconds."""
        return self.prompt and not self._at_work

    def tell_notes(self) -> None:
        said = self.everyone(rank_logging.take())
        if self.first:
            rank_logging.tell(dict(enumerate(said)))

    @property
    def waiting_since(self) -> float | None:
        """When, of `running_seconds`, the collective call began that this rank, or its GPU, waits for; None if none."""
        called, queued = self._called, self._queued
        if called is not None or queued is None:
            return called
        with contextlib.suppress(RuntimeError):  # of the GPU, which the main thread will meet
            return None if queued[0].query() else queued[1]
        return None

    def _note_queued(self) -> None:
        if self.by_gpu:
            event = self._queued[0] if self._queued else torch.cuda.Event()
            event.record()
            self._queued = event, self._called

    def leave(self, done: bool) -> None:
        """Close the connections, so that ranks that wait for this one wait no longer.

        done: all ranks have come to the end. If not, NCCL's are left to the end of the process: they close when all
        their calls are done, and another rank may never come to one.
        """
        numbers, self._numbers = self._numbers, None
        if not dist.is_initialized():
            return
        if done or not self.by_gpu:
            dist.destroy_process_group()
        else:
            dist.destroy_process_group(numbers)

    numbers = _watched(SeveralRanks.numbers)
    shared = _watched(SeveralRanks.shared)
    handed = _watched(SeveralRanks.handed)
    everyone = _watched(SeveralRanks.everyone)
    agree = _watched(SeveralRanks.agree)
    table = _watched(SeveralRanks.table)
    added = _watched(SeveralRanks.added)
    send = _watched(SeveralRanks.send)
