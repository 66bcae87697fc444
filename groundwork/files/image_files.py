"""Image files: formats, reading of photos and of renders of any size, 8-bit PNGs, and 16-bit PNGs of one plane.

torch is imported on first use: not every program needs it.
"""

from __future__ import annotations

import os
import re
import struct
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, PngImagePlugin

from groundwork.files.color_tags import add_profile
from groundwork.files.plain_files import plain_path
from groundwork.files.writing import atomic_write
from groundwork.host.errors import UserError
from groundwork.host.machine import threads

if TYPE_CHECKING:
    import torch

MOST_PIXELS = 1 << 28  # 16384 a side, the largest training size; Pillow's own limit is lower
Image.MAX_IMAGE_PIXELS = MOST_PIXELS // 2  # Pillow warns beyond it, and refuses beyond twice as many
UNREADABLE = (
    *(OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError),
    *(TypeError, LookupError, ArithmeticError, struct.error),
)  # Pillow raises these for broken files, depending on the format
SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
HEIF_SUFFIXES = (".heic", ".heif", ".hif", ".avif")
RAW_SUFFIXES = (
    *(".dng", ".cr2", ".cr3", ".nef", ".nrw", ".arw", ".sr2", ".raf", ".orf", ".rw2", ".pef", ".srw", ".3fr", ".iiq"),
    *(".gpr", ".rwl", ".x3f"),
)
# Files of these names are taken for photos before they are opened; those that cannot be used are named later.
PHOTO_SUFFIXES = (*SUFFIXES, *HEIF_SUFFIXES, *RAW_SUFFIXES, ".jp2", ".tga", ".ppm")
VIDEO_SUFFIXES = (
    *(".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".m2ts", ".mpg", ".3gp", ".wmv"),
    *(".insv", ".360", ".osv"),  # of cameras with two lenses
)
# What photos come in. Pillow knows more formats, and hands some of them, as PostScript, to other programs, whatever the
# file's name is.
FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP", "GIF", "PPM", "JPEG2000", "AVIF", "HEIF", "TGA")
PNG_LEVEL = 1  # of zlib, as 6 takes four times as long for files that are 8 % smaller (docs/results/waiting.md)
_PIXELS_HELD = 1 << 26  # of pictures that wait to be written
SCALE = "scale"  # key of a plane's text chunk: value = pixel * scale
_STEPS = 65535
_EIGHT_BITS = ((np.arange(1 << 16) + 128) // 257).astype(np.uint8)  # of a 16-bit grey; 255 is 65535
_DIM = 0.3  # brightness of what a mask leaves out


def open_image(path: Path) -> Image.Image:
    """Open an image file of one of FORMATS; its pixels are read later. Raises one of UNREADABLE if that fails.

    HEIF only where a reader of it was added to Pillow. A photo without an ICC profile gets that of `add_profile`.
    """
    path = plain_path(path)
    image = Image.open(path, formats=[name for name in FORMATS if name != "HEIF" or name in Image.OPEN])
    add_profile(image, path)
    return image


def to_sixteen_bits(image: Image.Image) -> Image.Image:
    """Convert a grey image of 16 bits, for which Pillow has several modes, to mode I;16."""
    return Image.fromarray(np.clip(np.asarray(image), 0, 65535).astype(np.uint16))


def to_eight_bits(image: Image.Image) -> Image.Image:
    """Convert a grey image of 16 bits to mode L. Pillow's own conversion clips at 255."""
    return Image.fromarray(_EIGHT_BITS[np.asarray(to_sixteen_bits(image))])


def to_bytes(image: torch.Tensor) -> torch.Tensor:
    """Convert an image (3, H, W), float in [0, 1] or already uint8, to (H, W, 3) uint8, halves rounded up."""
    import torch

    if image.dtype != torch.uint8:
        image = (image.clamp(0, 1) * 255 + 0.5).to(torch.uint8)
    return image.permute(1, 2, 0).contiguous().cpu()


def dim_masked(image: torch.Tensor, counts: torch.Tensor) -> torch.Tensor:
    """Darken an image (3, H, W), float, where the mask `counts` (1, H, W) bool is False."""
    import torch

    return torch.where(counts, image, _DIM * image)


def save_png(image: torch.Tensor, path: Path) -> None:
    """Write an image of a form that `to_bytes` takes; the file is written whole or not at all."""
    write_png(to_bytes(image).numpy(), path)


def write_png(pixels: np.ndarray, path: str | os.PathLike, text: PngImagePlugin.PngInfo | None = None) -> None:
    """Write pixels (H, W, 3) uint8, or (H, W) uint8 or uint16, as a PNG, whole or not at all; in any thread."""
    with atomic_write(path) as temporary:
        Image.fromarray(pixels).save(temporary, compress_level=PNG_LEVEL, pnginfo=text)


def pictures_at_once(pixels: int) -> int:
    """Return how many pictures of so many pixels are held while `in_threads` reads or writes them."""
    return max(1, min(threads(), _PIXELS_HELD // max(pixels, 1)))


def remove_leftovers(folder: Path, count: int) -> None:
    """Delete the numbered PNGs from `count` on, which an earlier run with more views has left."""
    for file in folder.glob("*.png"):
        if re.fullmatch(r"\d{5,}", file.stem) and int(file.stem) >= count:
            file.unlink()


def replace_pictures(folder: Path, new: Path) -> None:
    """Let the pictures of the folder `new`, which may be missing, take the place of the numbered PNGs of `folder`.

    Other files stay. However this ends, the folder has no pictures of both.
    """
    remove_leftovers(folder, 0)
    if new.is_dir():
        try:
            os.replace(new, folder)
        except OSError:  # it has other files
            for file in sorted(new.iterdir()):
                with atomic_write(folder / file.name) as temporary:
                    os.replace(file, temporary)


def write_plane(path: str | os.PathLike, values: np.ndarray, largest: float | None = None) -> None:
    """Write values (H, W), at least 0, as a 16-bit PNG; whole or not at all.

    Values are rounded to the nearest of 65,536 steps up to `largest`. The value of a step stands in the PNG as the text
    SCALE, by which `read_plane` returns values.

    largest: the value of the brightest pixel; None: the largest of the values.
    """
    top = float(values.max(initial=0.0)) if largest is None else largest
    scale = (top or 1.0) / _STEPS
    steps = np.clip(np.round(values.astype(np.float64) / scale), 0, _STEPS).astype(np.uint16)
    text = PngImagePlugin.PngInfo()
    text.add_text(SCALE, repr(scale))
    write_png(steps, path, text)


def plane_scale(path: Path) -> float | None:
    """Value of a step of a file that `write_plane` wrote; None for other files."""
    try:
        with open_image(path) as image:
            return float(image.text[SCALE])
    except (*UNREADABLE, AttributeError, KeyError, ValueError):
        return None


def read_plane(path: str | os.PathLike) -> np.ndarray:
    """Read what `write_plane` wrote: (H, W) float64, each within half a step. UserError for a file that is no plane."""
    try:
        with open_image(Path(path)) as image:
            return np.asarray(image, dtype=np.float64) * float(image.text[SCALE])
    except (*UNREADABLE, AttributeError, KeyError, ValueError) as error:
        raise UserError(f"cannot read {path} as a plane of numbers ({error}); render.py writes such files") from error
