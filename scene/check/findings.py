"""The record of a fault that the check of a scene finds."""

from typing import NamedTuple


class Finding(NamedTuple):
    """A fault of a scene, and what to do about it.

    severe: no training can make anything of the scene. of_lens: it explains why points do not fit the photos.
    """

    text: str
    remedy: str
    severe: bool = False
    of_lens: bool = False

    def __str__(self) -> str:
        return f"{self.text}; {self.remedy}"
