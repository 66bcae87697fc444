"""Several processes that train together, by torch.distributed: gloo on CPUs, NCCL on GPUs."""

from collections.abc import Sequence
from math import prod

import torch
import torch.distributed as dist
from torch import Tensor

from utils.ranks.ranks import Ranks, Value


class SeveralRanks(Ranks):
    """The ranks of the default process group.

    Numbers and objects go by a group of CPUs. Rows go by NCCL, where the group has it, or else by way of the CPU.
    """

    def __init__(self) -> None:
        self.rank, self.size = dist.get_rank(), dist.get_world_size()
        self._by_gpu = dist.get_backend() == "nccl"
        self._numbers = dist.new_group(backend="gloo") if self._by_gpu else dist.group.WORLD

    def numbers(self, *values: int) -> Tensor:
        mine = torch.tensor(values, dtype=torch.int64)
        everyone = [torch.empty_like(mine) for _ in range(self.size)]
        dist.all_gather(everyone, mine, group=self._numbers)
        return torch.stack(everyone)

    def shared(self, value: Value) -> Value:
        box = [value]
        dist.broadcast_object_list(box, src=0, group=self._numbers)
        return box[0]

    def everyone(self, value: Value) -> list[Value]:
        box: list = [None] * self.size
        dist.all_gather_object(box, value, group=self._numbers)
        return box

    def largest_(self, numbers: Tensor) -> None:
        dist.all_reduce(numbers, dist.ReduceOp.MAX, group=None if numbers.is_cuda else self._numbers)

    def exchange(self, parts: Sequence[Tensor]) -> list[Tensor]:
        counts = self.numbers(*map(len, parts))[:, self.rank].tolist()
        shape, dtype, device = parts[0].shape[1:], parts[0].dtype, parts[0].device
        width = prod(shape) * dtype.itemsize  # bytes of a row
        if not width:
            return [parts[0].new_empty(count, *shape) for count in counts]
        place = device if self._by_gpu else "cpu"
        sent = torch.cat([part.detach().contiguous().view(-1).view(torch.uint8) for part in parts]).to(place)
        received = torch.empty(width * sum(counts), dtype=torch.uint8, device=place)
        dist.all_to_all_single(received, sent, [width * n for n in counts], [width * len(part) for part in parts])
        pieces = received.to(device).split([width * n for n in counts])
        return [_rows(piece, dtype, count, shape) for piece, count in zip(pieces, counts, strict=True)]


def _rows(piece: Tensor, dtype: torch.dtype, count: int, shape: torch.Size) -> Tensor:
    """The rows in some bytes, copied where these begin at an odd place."""
    if piece.storage_offset() % dtype.itemsize:
        piece = piece.clone()
    return piece.view(dtype).view(count, *shape)
