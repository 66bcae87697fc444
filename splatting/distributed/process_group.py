"""Several processes that train together, by torch.distributed: gloo on CPUs, NCCL on GPUs.

Their collective calls are watched, so that one that fails or never returns ends in a sentence.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from functools import wraps
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from splatting.distributed import rank_logging
from splatting.distributed.ranks import Ranks, Value
from splatting.host.clock import running_seconds
from splatting.host.memory import is_out_of_memory
from splatting.host.read_later import read_later

# Into one tensor. The older name warns where there is a newer one.
ALL_GATHER = "all_gather_single" if hasattr(dist, "all_gather_single") else "all_gather_into_tensor"
_NEWS = 2  # numbers that are posted
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
    def wrapped(self: "SeveralRanks", *args: Any, **named: Any) -> Any:
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


class SeveralRanks(Ranks):
    """The ranks of the default process group.

    Numbers and objects of the host go by a group of CPUs. Tensors go by NCCL, where the group has it, or else by way of
    the CPU.

    by_gpu: whether there is NCCL. A call then returns before the GPU has done it. calls: collective calls so far, the
    same number on all ranks that are in the same call. longest: seconds that one took while `prompt`. stands: says what
    is left of the training if a rank is lost, and how to go on.
    """

    def __init__(self) -> None:
        self.rank, self.size = dist.get_rank(), dist.get_world_size()
        self.by_gpu = dist.get_backend() == "nccl"
        self._place = "cuda" if self.by_gpu else "cpu"  # of what the default group sends
        self._numbers = dist.new_group(backend="gloo") if self.by_gpu else dist.group.WORLD
        self._silence = torch.zeros(_NEWS, dtype=torch.int64, device=self._place)
        self._news, self._heard = [0] * _NEWS, [0] * _NEWS
        self.calls = 0
        self._called: float | None = None  # when the running call began
        self._queued: tuple[torch.cuda.Event, float] | None = None  # the end of the last one on a GPU, and its begin
        self.longest = 0.0
        self._at_work = 0
        self.stands: Callable[[], str] = lambda: "start it again"

    @_watched
    def numbers(self, *values: int) -> Tensor:
        mine = torch.tensor(values, dtype=torch.int64)
        everyone = [torch.empty_like(mine) for _ in range(self.size)]
        dist.all_gather(everyone, mine, group=self._numbers)
        return torch.stack(everyone)

    @_watched
    def shared(self, value: Value, holder: int = 0) -> Value:
        box = [value]
        dist.broadcast_object_list(box, src=holder, group=self._numbers)
        return box[0]

    @_watched
    def handed(
        self, holder: int, values: Tensor | None, shape: Sequence[int], dtype: torch.dtype, device: torch.device
    ) -> Tensor:
        if self.rank == holder:
            dist.broadcast(values.detach().contiguous().to(self._place), holder)
            return values
        received = torch.empty(shape, dtype=dtype, device=self._place)
        dist.broadcast(received, holder)
        return received.to(device)

    @_watched
    def everyone(self, value: Value) -> list[Value]:
        box: list = [None] * self.size
        dist.all_gather_object(box, value, group=self._numbers)
        return box

    @_watched
    def agree(self, numbers: Tensor, meanwhile: Callable[[], None] = lambda: None) -> list[list[int]]:
        news = torch.tensor(self._news, device=self._place) if any(self._news) else self._silence
        flag = self._silence[:1] if self.flag is None else self.flag.to(self._place)
        found = read_later(self._table(torch.cat((numbers.to(self._place), flag, news))))
        meanwhile()
        found = found()
        first = len(numbers)
        flags = [row[first] for row in found]
        if flags[self.rank] < max(flags):
            self.flag.fill_(max(flags))
        self._heard = [max(each) for each in zip(*(row[first + 1 :] for row in found), strict=True)]
        return [row[:first] for row in found]

    def post(self, *news: int) -> None:
        self._news, self._heard = news, None

    def heard(self) -> Sequence[int]:
        if self._heard is None:
            self.agree(self._silence[:0])
        return self._heard

    @_watched
    def table(self, values: Tensor) -> Tensor:
        return self._table(values.detach().contiguous().to(self._place)).to(values.device)

    def _table(self, mine: Tensor) -> Tensor:
        every = mine.new_empty(self.size * mine.numel())
        getattr(dist, ALL_GATHER)(every, mine.view(-1))
        return every.view(self.size, *mine.shape)

    @_watched
    def added(self, values: Tensor) -> Tensor:
        total = values.detach().to(self._place)
        dist.all_reduce(total)
        return total.to(values.device)

    @_watched
    def send(self, rows: Tensor, sizes: Sequence[int], counts: Sequence[int] | None = None) -> tuple[Tensor, list[int]]:
        counts = self._counts(sizes) if counts is None else list(counts)
        sent = rows.detach().to(self._place).contiguous()
        received = sent.new_empty(sum(counts), *rows.shape[1:])
        if all(rows.shape[1:]):
            dist.all_to_all_single(received, sent, counts, list(sizes))
        return received.to(rows.device), counts

    def _counts(self, sizes: Sequence[int]) -> list[int]:
        """How many rows each rank sends here, where this one sends `sizes`."""
        sent = torch.tensor(sizes, dtype=torch.int64, device=self._place)
        counts = torch.empty_like(sent)
        dist.all_to_all_single(counts, sent)
        return counts.tolist()

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
