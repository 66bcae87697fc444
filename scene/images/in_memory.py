"""Pictures that were given as pixels, and need no decoding."""

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True, eq=False)
class InMemory:
    """Pixels at training size.

    A photo (3,H,W), or (4,H,W) with alpha: uint8 with straight alpha, as `scene.images.decode.decode` gives it, or
    float in [0,1] with colours that are multiplied by alpha already. A depth map: (1,H,W) float32.
    """

    pixels: Tensor

    def changed(self, change: Callable[[Tensor], Tensor]) -> "InMemory":
        """Another picture, made of this one now."""
        return InMemory(change(self.pixels))

    def __deepcopy__(self, memo: dict) -> "InMemory":
        return self  # never changed in place, so that copies of a camera can share it
