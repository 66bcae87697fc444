"""Communication of several ranks by torch.distributed: gloo on CPUs, NCCL on GPUs."""

from collections.abc import Callable, Sequence
from datetime import timedelta

import torch
import torch.distributed as dist
from torch import Tensor

from groundwork.host.read_later import read_later
from groundwork.ranks.ranks import Ranks, Value

# Into one tensor. The older name warns where there is a newer one.
ALL_GATHER = "all_gather_single" if hasattr(dist, "all_gather_single") else "all_gather_into_tensor"
_NEWS = 2  # numbers that `piggyback` leaves
# Of a collective call, after which a rank that does not come to it is taken for hung. No work of one rank that the
# others wait for may take longer, as rank 0 writing a checkpoint.
TIMEOUT = timedelta(minutes=2)


class SeveralRanks(Ranks):
    """The ranks of the default process group.

    Numbers and objects of the host use a gloo group. Tensors use NCCL if the group has it, else copies on the CPU.

    Some numbers are in no hurry, and travel along with `all_gather_ints` in place of a message of their own: the `flag`
    of each rank, a tensor that the call raises to the largest of all ranks; and two numbers that a rank leaves by
    `piggyback`, whose maxima over all ranks `latest` returns.
    """

    def __init__(self) -> None:
        """Take rank and size from torch's process group, and make a group on the CPU for numbers."""
        self.rank, self.size = dist.get_rank(), dist.get_world_size()
        by_gpu = dist.get_backend() == "nccl"
        self._place = "cuda" if by_gpu else "cpu"  # of what the default group sends
        self._numbers = dist.new_group(backend="gloo", timeout=TIMEOUT) if by_gpu else dist.group.WORLD
        self._zeros = torch.zeros(_NEWS, dtype=torch.int64, device=self._place)  # what a rank sends that has no news
        self._piggybacked = [0] * _NEWS  # this rank's
        self._latest = [0] * _NEWS  # maxima over ranks; None until those of the last `piggyback` have travelled

    def leave(self) -> None:
        """Leave the group and end its threads: a thread that is left at Python's exit aborts the process."""
        self._numbers = None  # which keeps the threads
        dist.destroy_process_group()

    def all_gather_host_ints(self, *values: int) -> Tensor:
        mine = torch.tensor(values, dtype=torch.int64)
        everyone = [torch.empty_like(mine) for _ in range(self.size)]
        dist.all_gather(everyone, mine, group=self._numbers)
        return torch.stack(everyone)

    def broadcast_object(self, value: Value, holder: int = 0) -> Value:
        box = [value]
        dist.broadcast_object_list(box, src=holder, group=self._numbers)
        return box[0]

    def broadcast_from(
        self, holder: int, values: Tensor | None, shape: Sequence[int], dtype: torch.dtype, device: torch.device
    ) -> Tensor:
        """Send `values` from the rank `holder` to all others; each returns them on its device.

        shape, dtype: of the values, which other ranks do not have (None). device: where others want them.
        """
        if self.rank == holder:
            dist.broadcast(values.detach().contiguous().to(self._place), holder)
            return values
        received = torch.empty(shape, dtype=dtype, device=self._place)
        dist.broadcast(received, holder)
        return received.to(device)

    def all_gather_objects(self, value: Value) -> list[Value]:
        box: list = [None] * self.size
        dist.all_gather_object(box, value, group=self._numbers)
        return box

    def all_gather_ints(self, numbers: Tensor, meanwhile: Callable[[], None] = lambda: None) -> list[list[int]]:
        """Gather integers of all ranks: a list for each rank, in the order of ranks.

        Flag and piggybacked numbers of all ranks are exchanged, too. The call sets `flag`, and what `latest` returns.

        numbers: (n,) int64 of this rank, as many on each rank.
        meanwhile: called while the numbers travel.
        """
        news = torch.tensor(self._piggybacked, device=self._place) if any(self._piggybacked) else self._zeros
        flag = self._zeros[:1] if self.flag is None else self.flag.to(self._place)
        found = read_later(self._all_gather(torch.cat((numbers.to(self._place), flag, news))))
        meanwhile()
        found = found()
        first = len(numbers)
        flags = [row[first] for row in found]
        if flags[self.rank] < max(flags):
            self.flag.fill_(max(flags))
        self._latest = [max(each) for each in zip(*(row[first + 1 :] for row in found), strict=True)]
        return [row[:first] for row in found]

    def piggyback(self, *news: int) -> None:
        self._piggybacked, self._latest = news, None

    def latest(self) -> Sequence[int]:
        if self._latest is None:
            self.all_gather_ints(self._zeros[:0])
        return self._latest

    def all_gather(self, values: Tensor) -> Tensor:
        return self._all_gather(values.detach().contiguous().to(self._place)).to(values.device)

    def _all_gather(self, mine: Tensor) -> Tensor:
        every = mine.new_empty(self.size * mine.numel())
        getattr(dist, ALL_GATHER)(every, mine.view(-1))
        return every.view(self.size, *mine.shape)

    def all_reduce_sum(self, values: Tensor) -> Tensor:
        total = values.detach().to(self._place)
        dist.all_reduce(total)
        return total.to(values.device)

    def send(self, rows: Tensor, sizes: Sequence[int], counts: Sequence[int] | None = None) -> tuple[Tensor, list[int]]:
        """Send rows (N, ...) to all ranks, and return the rows received with their number from each rank.

        sizes: number of rows for each rank. counts: number of rows from each rank, None: asked of them.
        """
        counts = self._exchange_counts(sizes) if counts is None else list(counts)
        sent = rows.detach().to(self._place).contiguous()
        received = sent.new_empty(sum(counts), *rows.shape[1:])
        if all(rows.shape[1:]):
            dist.all_to_all_single(received, sent, counts, list(sizes))
        return received.to(rows.device), counts

    def _exchange_counts(self, sizes: Sequence[int]) -> list[int]:
        """Exchange row counts: this rank sends sizes[r] rows to rank r; returns how many each rank sends here."""
        sent = torch.tensor(sizes, dtype=torch.int64, device=self._place)
        counts = torch.empty_like(sent)
        dist.all_to_all_single(counts, sent)
        return counts.tolist()
