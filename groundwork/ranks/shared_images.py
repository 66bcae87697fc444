"""Images that ranks share: each image is decoded and kept by one rank, and broadcast when all need it."""

from collections.abc import Callable, Hashable, Iterable, Mapping
from functools import cache, partial

import torch
from torch import Tensor

from groundwork.host.errors import UserError
from groundwork.host.memory import is_out_of_memory
from groundwork.ranks.ranks import Ranks


def share_images(
    sizes: Mapping[Hashable, int], own: Callable[[Hashable], Tensor], device: torch.device, ranks: Ranks
) -> tuple[set[Hashable], dict[Hashable, "SharedImage"]]:
    """Divide images among ranks: return the keys that this rank decodes, and all images as shared ones.

    A shared image has the attributes of InMemory; all ranks read its pixels together.

    sizes: bytes of each image.
    own: decodes the image of a key to `device`.
    """
    chosen = dict(zip(sizes, assign_holders(sizes.values(), ranks.size), strict=True))
    shared = {key: SharedImage(ranks, chosen[key], partial(own, key), device) for key in sizes}
    return {key for key in sizes if chosen[key] == ranks.rank}, shared


class SharedImage:
    """An image that one rank, the holder, decodes and keeps.

    ranks: all ranks that use the image.
    own: decodes the image to `device`; only the holder calls it.
    """

    def __init__(self, ranks: Ranks, holder: int, own: Callable[[], Tensor], device: torch.device) -> None:
        self._ranks, self._holder, self._own, self._device = ranks, holder, own, device
        self._form: tuple[torch.Size, torch.dtype] | None = None

    def __deepcopy__(self, memo: dict) -> "SharedImage":
        return self  # never changed in place, so that copies of a camera can share it

    @property
    def pixels(self) -> Tensor:
        """The image; all ranks have to read it together. A UserError of the holder is raised on all ranks.

        Shape and dtype are known only after decoding, so the holder first broadcasts these, or its error.
        """
        mine = None
        if self._form is None:
            mine, self._form = self._decode_in_holder()
        elif self._ranks.rank == self._holder:
            mine = self._own()
        return self._ranks.broadcast_from(self._holder, mine, *self._form, self._device)

    def _decode_in_holder(self) -> tuple[Tensor | None, tuple[torch.Size, torch.dtype]]:
        """Decode the image in its holder's process; return it, None elsewhere, and its shape and dtype in all.

        UserError in all processes where the holder cannot decode it.
        """
        mine = said = None
        if self._ranks.rank == self._holder:
            try:
                mine = self._own()
                said = mine.shape, mine.dtype
            except UserError as error:
                if is_out_of_memory(error):  # of this rank alone
                    raise
                said = str(error)
        said = self._ranks.broadcast_object(said, self._holder)
        if isinstance(said, str):
            raise UserError(said)
        return mine, said

    def transformed(self, change: Callable[[Tensor], Tensor]) -> "SharedImage":
        """Return another image, which the holder makes of this one on its first use, and keeps."""
        return SharedImage(self._ranks, self._holder, cache(lambda: change(self._own())), self._device)


def assign_holders(sizes: Iterable[int], ranks: int) -> list[int]:
    """Choose for each image, of `sizes` bytes, the rank that holds the fewest bytes so far.

    Images of one size go to ranks 0, 1, 2 and so on in turn.
    """
    filled, chosen = [0] * ranks, []
    for size in sizes:
        chosen.append(filled.index(min(filled)))
        filled[chosen[-1]] += size
    return chosen
