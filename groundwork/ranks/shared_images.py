"""Images that ranks share: each image is decoded and kept by one rank, and broadcast when all need it."""

from collections.abc import Callable, Hashable, Iterable, Mapping
from functools import cache, partial

import torch
from torch import Tensor

from groundwork.host.errors import UserError
from groundwork.host.memory import is_out_of_memory
from groundwork.ranks.ranks import Ranks


def divided(
    sizes: Mapping[Hashable, int], own: Callable[[Hashable], Tensor], device: torch.device, ranks: Ranks
) -> tuple[set[Hashable], dict[Hashable, "SharedImage"]]:
    """Of images, given with their bytes, those that this rank decodes, and all as shared ones.

    own: the image of a key, on `device`. A shared image has the attributes of InMemory; all ranks read its pixels
    together.
    """
    chosen = dict(zip(sizes, holders(sizes.values(), ranks.size), strict=True))
    shared = {key: SharedImage(ranks, chosen[key], partial(own, key), device) for key in sizes}
    return {key for key in sizes if chosen[key] == ranks.rank}, shared


class SharedImage:
    """An image that its holder alone decodes and keeps.

    ranks: all that use it; holder: one of them. own: gives the image on `device`, and is called by the holder only.
    """

    def __init__(self, ranks: Ranks, holder: int, own: Callable[[], Tensor], device: torch.device) -> None:
        self._ranks, self._holder, self._own, self._device = ranks, holder, own, device
        self._form: tuple[torch.Size, torch.dtype] | None = None

    def __deepcopy__(self, memo: dict) -> "SharedImage":
        return self  # never changed in place, so that copies of a camera can share it

    @property
    def pixels(self) -> Tensor:
        """The image on all ranks, which have to ask for it together. UserError on all, as of the holder.

        Only decoding shows its shape, and whether it can be read at all; the holder says so at first.
        """
        mine = None
        if self._form is None:
            mine, self._form = self._decoded()
        elif self._ranks.rank == self._holder:
            mine = self._own()
        return self._ranks.handed(self._holder, mine, *self._form, self._device)

    def _decoded(self) -> tuple[Tensor | None, tuple[torch.Size, torch.dtype]]:
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

    def changed(self, change: Callable[[Tensor], Tensor]) -> "SharedImage":
        """Another image, which the same rank makes of this one when all first ask for it, and keeps."""
        return SharedImage(self._ranks, self._holder, cache(lambda: change(self._own())), self._device)


def holders(sizes: Iterable[int], ranks: int) -> list[int]:
    """The rank that keeps each image, of so many bytes: the one that has the fewest so far.

    So images of one size go to ranks 0, 1, 2 and so on in turn.
    """
    filled, chosen = [0] * ranks, []
    for size in sizes:
        chosen.append(filled.index(min(filled)))
        filled[chosen[-1]] += size
    return chosen
