"""Image files: suffixes and formats, exceptions of reading them, and opening of photos and of renders of any size."""

import struct
import warnings
from pathlib import Path

from PIL import Image

from splatting.files.plain_files import plain

MOST_PIXELS = 1 << 28  # 16384 a side, the largest training size; Pillow's default limit is lower
UNREADABLE = (
    *(OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError),
    *(TypeError, LookupError, ArithmeticError, struct.error),
)  # Pillow raises these for broken files, depending on the format
SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
# What photos come in. Pillow knows more formats, and hands some of them, as PostScript, to other programs, whatever the
# file's name is.
FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP", "GIF", "PPM", "JPEG2000", "TGA")


def open_image(path: Path) -> Image.Image:
    """Open an image file of one of FORMATS; its pixels are read later. Raises one of UNREADABLE if that fails."""
    return Image.open(plain(path), formats=FORMATS)


def open_render(path: Path) -> Image.Image:
    """Open an image file; its pixels are read later. Raises one of UNREADABLE if that fails."""
    usual = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = MOST_PIXELS
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            return open_image(path)
    except Image.DecompressionBombWarning as error:
        raise Image.DecompressionBombError(str(error)) from error
    finally:
        Image.MAX_IMAGE_PIXELS = usual
