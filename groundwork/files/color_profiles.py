"""Colours of photos by their ICC profiles, also those of color_tags.py: other spaces become sRGB, as all else here."""

import functools
import io
import sys
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageCms
from tqdm import tqdm

from groundwork.files.color_tags import UNKNOWN
from groundwork.files.image_files import to_eight_bits, to_sixteen_bits

_NEAR = 2  # of 255, that profiles of sRGB by several makers differ
_MODES = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}  # Pillow's modes of the spaces that profiles are of
_SAID: set[str] = set()


class _Change(NamedTuple):
    """The transform to sRGB, None: colours stay; Pillow's mode that it takes; a message to print, "" for none."""

    transform: ImageCms.ImageCmsTransform | None
    mode: str = ""
    said: str = ""


def has_other_colors(image: Image.Image) -> bool:
    """Tell by a photo's header whether its profile means other colours than sRGB; a message says so once."""
    return _find_change(image).transform is not None


def to_srgb(image: Image.Image) -> Image.Image:
    """Return a photo in sRGB, as RGB or RGBA; the photo itself if it has no profile, or one of no effect."""
    change = _find_change(image)
    if change.transform is None:
        return image
    alpha = image.convert("RGBA").getchannel("A") if image.has_transparency_data else None
    if image.mode.startswith("I"):
        image = to_sixteen_bits(image) if change.mode == "I;16" else to_eight_bits(image)
    result = change.transform.apply(image if image.mode == change.mode else image.convert(change.mode))
    if alpha:
        result.putalpha(alpha)
    return result


def _find_change(image: Image.Image) -> _Change:
    """Return the change of colours that makes a photo sRGB, and print its message at its first use."""
    mode = "I;16" if image.mode.startswith("I") else {"LA": "L", "1": "L"}.get(image.mode, image.mode)
    if profile := image.info.get("icc_profile"):
        change = _read_profile(profile, mode)
    elif unknown := image.info.get(UNKNOWN):
        change = _Change(None, said=f"warning: photos are taken as sRGB, though their colours are of {unknown}")
    else:
        return _Change(None)
    if change.said and change.said not in _SAID:
        _SAID.add(change.said)
        name = getattr(image, "filename", "")
        tqdm.write(f"{change.said}; the first is {name}" if name else change.said, file=sys.stderr)
    return change


@functools.lru_cache(maxsize=64)
def _read_profile(profile: bytes, mode: str) -> _Change:
    """Return the change of colours of an ICC profile, for images of a Pillow mode; none if it is sRGB or unusable."""
    grey = mode in ("L", "I;16")
    try:
        source, target = ImageCms.ImageCmsProfile(io.BytesIO(profile)), ImageCms.createProfile("sRGB")
        space = _MODES.get(source.profile.xcolor_space.strip(), "")
        if space != ("L" if grey else "CMYK" if mode == "CMYK" else "RGB") and not (grey and space == "RGB"):
            raise ValueError("it is of another kind of photo")
        mode = mode if grey and space == "L" else space
        transform = ImageCms.buildTransform(source, target, mode, "RGB")
        name = " ".join(ImageCms.getProfileDescription(source).split())
    except (ImageCms.PyCMSError, ImportError, OSError, ValueError, TypeError) as error:
        return _Change(None, said=f"warning: colour profiles are ignored that cannot be followed ({error})")
    if space != "CMYK" and _is_srgb(transform, "L" if grey else "RGB"):
        return _Change(None)
    return _Change(transform, mode, f"photos with the colour profile {name} are converted to sRGB")


def _is_srgb(transform: ImageCms.ImageCmsTransform, shown: str) -> bool:
    """Tell whether a transform leaves colours as they are. shown: mode of the photo: L for greys, else RGB."""
    steps = np.arange(0, 256, 17, dtype=np.uint8)
    colors = np.stack([steps] * 3 if shown == "L" else np.meshgrid(*[steps] * 3), -1).reshape(-1, 16, 3)
    given = Image.fromarray(np.ascontiguousarray(colors))
    if transform.input_mode == "I;16":
        given = Image.fromarray(np.asarray(given.convert("L")).astype(np.uint16) * 257)
    made = np.asarray(transform.apply(given.convert(transform.input_mode)), np.int16)
    return bool(np.abs(made - colors).max() <= _NEAR)
