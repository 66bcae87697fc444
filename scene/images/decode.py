"""Photos from files: checked early, decoded at training size as uint8."""

import os
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from groundwork.files.color_profiles import has_other_colors, to_srgb
from groundwork.files.image_files import MOST_PIXELS, UNREADABLE, open_image, to_eight_bits, to_sixteen_bits
from groundwork.files.plain_files import describe_wrong_file
from groundwork.host.listing import some
from utils.system_utils import UserError

_TAIL = 4096
# Large photos are normal here; Pillow's own limit still refuses absurd sizes. The filter is set once, because filters
# set for a block apply to all threads.
warnings.filterwarnings("ignore", category=Image.DecompressionBombWarning)


def picture_size(path: Path, colors: bool = False) -> tuple[int, int]:
    """Size (width, height) of an image file, from its header. UserError for a file that is broken or cut short.

    A file that lacks its format's end mark is decoded, to find out whether it is complete. colors: of a photo, whose
    colour profile is told of before anything is decoded.
    """
    try:
        with open_image(path) as image:
            size = image.size
            _refuse_float(image)
            if colors:
                has_other_colors(image)
            if not _has_end_mark(path, image.format):
                image.load()
    except (*UNREADABLE, MemoryError) as error:
        raise _make_read_error(path, error) from error
    return size


def picture_sizes(paths: Sequence[Path]) -> list[tuple[int, int]]:
    """The sizes of photos. A UserError names all that are broken or cut short."""
    sizes, errors = [], []
    for path in paths:
        try:
            sizes.append(picture_size(Path(path), colors=True))
        except UserError as error:
            errors.append((path, error))
    if len(errors) > 1:
        names = some([str(path) for path, _ in errors])
        raise UserError(
            f"{len(errors)} of {len(paths)} photos cannot be read: {names}; replace them or take them out of the scene"
        ) from errors[0][1]
    if errors:
        raise errors[0][1]
    return sizes


def may_be_transparent(path: Path) -> bool:
    """Tell whether a readable image file has an alpha channel or a transparent colour, from its header."""
    with open_image(path) as image:
        return image.has_transparency_data


def decode(path: Path, size: tuple[int, int], opaque: bool = False) -> Tensor:
    """Do as `pixels_of` for a file; EXIF orientation is ignored, as in COLMAP. UserError if it cannot be read."""
    try:
        with open_image(path) as image:
            return pixels_of(image, size, opaque)
    except UNREADABLE as error:
        raise _make_read_error(path, error) from error
    except MemoryError as error:
        raise UserError(
            f"not enough memory for {path} at {size[0]} x {size[1]} pixels; choose a smaller size with -r"
        ) from error


def grey_values(path: Path) -> np.ndarray:
    """The alpha (H, W) of an image file if it has any, else its brightness: uint8, or uint16 of 16-bit grey.

    UserError for a file that cannot be read.
    """
    try:
        with open_image(path) as image:
            if image.mode.startswith("I"):
                return np.asarray(to_sixteen_bits(image))
            image.info.pop("icc_profile", None)  # its values are no colours
            pixels = pixels_of(image, image.size).numpy()
    except (*UNREADABLE, MemoryError) as error:
        raise _make_read_error(path, error) from error
    return pixels[3] if len(pixels) == 4 else pixels.max(axis=0)


def pixels_of(image: Image.Image, size: tuple[int, int], opaque: bool = False) -> Tensor:
    """Image (3,H,W) uint8, or (4,H,W) with straight alpha if it has any, at size (width, height).

    Resized by Pillow's bicubic filter, antialiased when shrinking, with colours weighted by alpha (premultiplied).
    Grey, palette, CMYK and 16-bit images become 8-bit RGB; a colour profile is followed to sRGB. opaque: alpha is
    dropped first.
    """
    image = _to_rgb_or_rgba(image, opaque)
    if image.size != size:
        image = image.resize(size, Image.Resampling.BICUBIC)
    pixels = np.asarray(image)
    if pixels.shape[-1] == 4 and pixels[..., 3].min() == 255:
        pixels = pixels[..., :3]
    return torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1)))


def _make_read_error(path: Path, error: Exception) -> UserError:
    """Return the error for an image that cannot be decoded, by the cause that its file or Pillow's error tells."""
    if other := describe_wrong_file(path):
        return UserError(f"{path} is {other}; download it again or take it out of the scene")
    if isinstance(error, Image.DecompressionBombError):
        return UserError(f"{path} has more than {MOST_PIXELS:,} pixels; make it smaller")
    if isinstance(error, UnidentifiedImageError) and path.suffix.lower() in (".tif", ".tiff"):
        return UserError(f"{path} is a TIFF of a kind that is not read, as of floats; save it with 8 or 16 bits")
    return UserError(
        f"cannot read {path} ({str(error) or type(error).__name__}); replace it or take it out of the scene"
    )


def _has_end_mark(path: Path, file_format: str | None) -> bool:
    """Tell whether the mark that ends a PNG or JPEG is in the file's tail; True for other formats."""
    marks = {"PNG": b"IEND", "JPEG": b"\xff\xd9"}
    if file_format not in marks:
        return True
    with open(path, "rb") as file:
        file.seek(max(os.path.getsize(path) - _TAIL, 0))
        return marks[file_format] in file.read()


def _refuse_float(image: Image.Image) -> None:
    if image.mode == "F":
        raise ValueError("floating-point pixels; save it with 8 or 16 bits")


def _to_rgb_or_rgba(image: Image.Image, opaque: bool) -> Image.Image:
    """Convert an image to sRGB with 8 bits, as RGB or, where it has alpha, RGBA. opaque: without alpha."""
    _refuse_float(image)
    image = to_srgb(image)
    if image.mode.startswith("I"):
        return to_eight_bits(image).convert("RGB")
    has_alpha = image.has_transparency_data and not opaque
    return image.convert("RGBA" if has_alpha else "RGB")
