"""JPEG files that are damaged in the middle, which decoders pass over: what follows is in wrong colours and places.

Where the coded data end too early, or are zeros, decoders repeat the last colour: blocks of 8 pixels a side that are
exactly equal, in long runs, which photos have none of.
"""

from collections.abc import Mapping
from pathlib import Path
from statistics import median

import numpy as np

from splatting.files.image_files import UNREADABLE, open_image
from splatting.host.listing import some

_RUN = 16  # blocks
_SHARE = 0.02  # of the blocks; sound photos have 0.0075 at most, grey ones 0.016, a file that lost a fifteenth 0.04
_USUAL = 8  # times the photos' median; sound ones of a low quality have 0.12 and 7.5 times that
_CLIPPED = 8  # of 255, from black and white, which photos have much of
_FEW = 0.25  # of the photos; where more have it, it is a background


def said_of(shares: Mapping[str, float | None]) -> tuple[str, str] | None:
    """Which photos are likely damaged, by their `equal_share`, and the remedy; None if none is."""
    measured = {name: share for name, share in shares.items() if share is not None}
    least = max(_SHARE, _USUAL * median(measured.values() or [0]))
    damaged = sorted(name for name, share in measured.items() if share > least)
    if not 0 < len(damaged) <= _FEW * len(measured):
        return None
    text = f"{len(damaged)} of the {len(measured)} JPEG photos that were checked are likely damaged in the middle"
    text += f", as parts of them are of exactly one colour ({some(damaged)})"
    return text, "copy them again, or take them out of the scene"


def equal_share(path: Path) -> tuple[float | None, int]:
    """Share of a JPEG's blocks in runs that are exactly equal, and its pixels; None of another file or a broken one."""
    try:
        with open_image(path) as image:
            if image.format not in ("JPEG", "MPO"):
                return None, 0
            size = image.width * image.height
            image.draft("RGB", (1, 1))  # a pixel a block
            return _flat(np.asarray(image.convert("RGB"), np.int16)), size
    except UNREADABLE:
        return None, 0


def _flat(blocks: np.ndarray) -> float:
    """Share of blocks (h, w, 3) in runs along a row that are exactly equal, and neither black nor white."""
    run = max(4, min(_RUN, blocks.shape[1] // 8))
    if blocks.shape[1] <= run:
        return 0.0
    same = np.lib.stride_tricks.sliding_window_view((np.diff(blocks, axis=1) == 0).all(2), run - 1, axis=1).all(2)
    flat = np.zeros(blocks.shape[:2], bool)
    for shift in range(run):
        flat[:, shift : shift + same.shape[1]] |= same
    return float((flat & (blocks.max(2) >= _CLIPPED) & (blocks.min(2) <= 255 - _CLIPPED)).mean())
