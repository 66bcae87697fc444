"""Picture files: their suffixes, what reading them raises, and renders of any size that can be rendered."""

import warnings
from pathlib import Path

from PIL import Image

MOST_PIXELS = 1 << 28  # 16384 a side, the largest training size; Pillow's own limit is lower
UNREADABLE = (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError)  # by format, on broken files
SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")


def open_render(path: Path) -> Image.Image:
    """Open a picture; its pixels are read later. Raises one of UNREADABLE where that fails."""
    usual = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = MOST_PIXELS
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            return Image.open(path)
    except Image.DecompressionBombWarning as error:
        raise Image.DecompressionBombError(str(error)) from error
    finally:
        Image.MAX_IMAGE_PIXELS = usual
