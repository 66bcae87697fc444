"""Where the rows of a model lie: what the slot `model.room` provides."""

from typing import Any

from torch import Tensor


class Room:
    """Leaves all rows on the device that computes. A part may divide them between that and the host (spilled.py).

    limit: bytes of the device that all which is trained may take; 0: all.
    """

    limit = 0

    def expect(self, count: int, scene: Any) -> None:
        """Take note of a number of this process's Gaussians that will come. scene: whose photos take memory, too."""

    def empty_rows(self, like: Tensor, rows: int) -> Tensor | None:
        """An uninitialised tensor for so many rows of f_rest; None: wherever torch puts it."""
        return None

    def host_bytes(self, count: int) -> int:
        """Bytes of so many Gaussians that lie on the host instead of the device."""
        return 0

    def remedy(self, count: int, lacking: float) -> str:
        """What to do where so many Gaussians lack so many bytes: the beginning of a sentence, or nothing."""
        return ""
