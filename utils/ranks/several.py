"""Several processes that train together, by torch.distributed: gloo on CPUs, NCCL on GPUs."""

from collections.abc import Sequence
from math import prod

import torch
import torch.distributed as dist
from torch import Tensor

from utils.ranks.ranks import Ranks, Value


class SeveralRanks(Ranks):
    """The ranks of the default process group.

    Numbers and objects of the host go by a group of CPUs. Tensors go by NCCL, where the group has it, or else by way of
    the CPU.

    by_gpu: whether there is NCCL. A call then returns before the GPU has done it.
    """

    def __init__(self) -> None:
        self.rank, self.size = dist.get_rank(), dist.get_world_size()
        self.by_gpu = dist.get_backend() == "nccl"
        self._place = "cuda" if self.by_gpu else "cpu"  # of what the default group sends
        self._numbers = dist.new_group(backend="gloo") if self.by_gpu else dist.group.WORLD

    def numbers(self, *values: int) -> Tensor:
        mine = torch.tensor(values, dtype=torch.int64)
        everyone = [torch.empty_like(mine) for _ in range(self.size)]
        dist.all_gather(everyone, mine, group=self._numbers)
        return torch.stack(everyone)

    def shared(self, value: Value, holder: int = 0) -> Value:
        box = [value]
        dist.broadcast_object_list(box, src=holder, group=self._numbers)
        return box[0]

    def handed(
        self, holder: int, values: Tensor | None, shape: Sequence[int], dtype: torch.dtype, device: torch.device
    ) -> Tensor:
        if self.rank == holder:
            dist.broadcast(values.detach().contiguous().to(self._place), holder)
            return values
        received = torch.empty(shape, dtype=dtype, device=self._place)
        dist.broadcast(received, holder)
        return received.to(device)

    def everyone(self, value: Value) -> list[Value]:
        box: list = [None] * self.size
        dist.all_gather_object(box, value, group=self._numbers)
        return box

    def largest_(self, numbers: Tensor) -> None:
        dist.all_reduce(numbers, dist.ReduceOp.MAX, group=None if numbers.is_cuda else self._numbers)

    def table(self, values: Tensor) -> Tensor:
        mine = values.detach().contiguous().to(self._place)
        every = mine.new_empty(self.size, *mine.shape)
        dist.all_gather(list(every.unbind()), mine)
        return every.to(values.device)

    def added(self, values: Tensor) -> Tensor:
        total = values.detach().to(self._place, copy=True)
        dist.all_reduce(total)
        return total.to(values.device)

    def send(self, rows: Tensor, sizes: Sequence[int], counts: Sequence[int] | None = None) -> tuple[Tensor, list[int]]:
        counts = self._counts(sizes) if counts is None else list(counts)
        shape, dtype, total = rows.shape[1:], rows.dtype, sum(counts)
        width = prod(shape) * dtype.itemsize  # bytes of a row
        if not width:
            return rows.new_empty(total, *shape), counts
        sent = rows.detach().contiguous().view(-1).view(torch.uint8).to(self._place)
        received = sent.new_empty(width * total)
        dist.all_to_all_single(received, sent, [width * n for n in counts], [width * n for n in sizes])
        return received.to(rows.device).view(dtype).view(total, *shape), counts

    def _counts(self, sizes: Sequence[int]) -> list[int]:
        """How many rows each rank sends here, where this one sends `sizes`."""
        sent = torch.tensor(sizes, dtype=torch.int64, device=self._place)
        counts = torch.empty_like(sent)
        dist.all_to_all_single(counts, sent)
        return counts.tolist()
