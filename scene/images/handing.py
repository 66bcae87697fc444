"""Handing over of pictures: one rank of a training decodes and keeps each, and the others get it when all need it."""

from collections.abc import Callable, Iterable
from functools import cache

import torch
from torch import Tensor

from scene.images.in_memory import InMemory
from splatting.distributed.ranks import Ranks
from splatting.host.memory import is_out_of_memory
from utils.system_utils import UserError


class Handed:
    """A picture that its holder alone decodes and keeps.

    ranks: all that use it; holder: one of them. own: gives the picture on `device`, and is called by the holder only.
    """

    def __init__(self, ranks: Ranks, holder: int, own: Callable[[], Tensor], device: torch.device) -> None:
        self._ranks, self._holder, self._own, self._device = ranks, holder, own, device
        self._form: tuple[torch.Size, torch.dtype] | None = None

    def __deepcopy__(self, memo: dict) -> "Handed":
        return self  # never changed in place, so that copies of a camera can share it

    @property
    def pixels(self) -> Tensor:
        """The picture, handed to all ranks, which have to ask for it together. UserError on all, as of the holder.

        What shape it has, and whether it can be read at all, only decoding shows; the holder says so at first.
        """
        mine = None
        if self._form is None:
            mine, self._form = self._told()
        elif self._ranks.rank == self._holder:
            mine = self._own()
        return self._ranks.handed(self._holder, mine, *self._form, self._device)

    def _told(self) -> tuple[Tensor | None, tuple[torch.Size, torch.dtype]]:
        mine = said = None
        if self._ranks.rank == self._holder:
            try:
                mine = self._own()
                said = mine.shape, mine.dtype
            except UserError as error:
                if is_out_of_memory(error):  # of this rank alone
                    raise
                said = str(error)
        said = self._ranks.shared(said, self._holder)
        if isinstance(said, str):
            raise UserError(said)
        return mine, said

    def changed(self, change: Callable[[Tensor], Tensor]) -> "Handed":
        """Another picture, which the same rank makes of this one when all first ask for it, and keeps."""
        return Handed(self._ranks, self._holder, cache(lambda: change(self._own())), self._device)


AT_HAND = (InMemory, Handed)  # pictures that have `pixels`, and that no store has to look for


def holders(sizes: Iterable[int], ranks: int) -> list[int]:
    """The rank that keeps each picture, of so many bytes: the one that has the fewest so far.

    So pictures of one size go to ranks 0, 1, 2 and so on in turn.
    """
    filled, chosen = [0] * ranks, []
    for size in sizes:
        chosen.append(filled.index(min(filled)))
        filled[chosen[-1]] += size
    return chosen
