"""16-bit PNGs of one plane of numbers, with the scale in a text chunk."""

import os

import numpy as np
from PIL import Image, PngImagePlugin

from splatting.files.image_files import UNREADABLE
from splatting.files.plain_files import plain
from utils.system_utils import UserError, atomic_write

SCALE = "scale"  # key of the text chunk: value = pixel * scale
MOST = 65535


def write_plane(path: str | os.PathLike, values: np.ndarray, largest: float | None = None) -> None:
    """Write values (H, W), at least 0, rounded to the nearest of 65,536 steps up to `largest`; whole or not at all.

    largest: the value of the brightest pixel; None: the largest of the values.
    """
    top = float(values.max(initial=0.0)) if largest is None else largest
    scale = (top or 1.0) / MOST
    steps = np.clip(np.round(values.astype(np.float64) / scale), 0, MOST).astype(np.uint16)
    text = PngImagePlugin.PngInfo()
    text.add_text(SCALE, repr(scale))
    with atomic_write(path) as temporary:
        Image.fromarray(steps).save(temporary, pnginfo=text)


def read_plane(path: str | os.PathLike) -> np.ndarray:
    """Read what `write_plane` wrote: (H, W) float64, each within half a step. UserError for a file that is no plane."""
    try:
        with Image.open(plain(path)) as image:
            return np.asarray(image, dtype=np.float64) * float(image.text[SCALE])
    except (*UNREADABLE, AttributeError, KeyError, ValueError) as error:
        raise UserError(f"cannot read {path} as a plane of numbers ({error}); render.py writes such files") from error
