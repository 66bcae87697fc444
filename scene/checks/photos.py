"""Checks of photos: sizes, photos of which no pixel counts, pixels that all photos share."""

import shlex
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import ExifTags, Image, ImageOps

from groundwork.applications import has_application
from groundwork.files.image_files import UNREADABLE, open_image
from groundwork.finding import Finding, Severity, fine
from groundwork.host.listing import counted, some
from groundwork.host.machine import threads
from groundwork.host.start import typed_command
from scene.checks.photo_files import shrunk
from scene.checks.shared_pixels import place_of, shared_pixels
from scene.images.decode import picture_size
from scene.images.masks import Mask
from scene.readers.info import CameraInfo
from utils.system_utils import UserError

LOOKED_AT = 16  # photos that a training decodes, small; any check finds shared pixels in these, for one share
FEWEST_VIEWS = 20
_WIDE = 1600  # pixels
SMALL = 32  # pixels; a smaller side has few more than SSIM's window
_PIXELS = 200  # a side, of what is looked at
_MOST_DECODED = 25_000_000  # pixels of all photos; a JPEG is decoded at an eighth of its size
_JPEG = 1 / 6  # cost of its pixels
_FEWEST = 8  # photos
_VISIBLE = 26  # of 255, an alpha that shows something
_SOME = 0.001  # share of the pixels that has to be seen
SHARED_TEXT = "is the same in nearly all photos"  # what the finding of shared pixels says
_HIDDEN = {
    "alpha": "save the photos without alpha, or leave their alpha out by --mask_meaning none",
    "masks": "draw what counts in white; --invert_masks is for masks of what is left out",
    "masks and alpha together": "check what masks and alpha mean (--mask_meaning, --invert_masks)",
}


class Photo(NamedTuple):
    """A photo without a camera yet, as it is displayed."""

    image_name: str
    image_path: Path
    mask: Mask | None = None

    @property
    def image(self) -> Image.Image | None:
        """The upright photo; None if the file is upright."""
        with open_image(self.image_path) as image:
            turned = image.getexif().get(ExifTags.Base.Orientation, 1) not in (0, 1)
            return ImageOps.exif_transpose(image) if turned else None


class Look(NamedTuple):
    """A reduced photo, with at most _PIXELS a side.

    pixels: (h, w, 3) uint8, sRGB. visible, kept: (h, w) bool, by alpha and by the mask. size: the photo's own width and
    height.
    """

    name: str
    pixels: np.ndarray
    visible: np.ndarray
    kept: np.ndarray
    size: tuple[int, int]

    @property
    def seen(self) -> np.ndarray:
        """Pixels (h, w) bool that count."""
        return self.visible & self.kept

    @property
    def hidden_by(self) -> str:
        """A key of _HIDDEN if nothing of the photo counts, else "" ."""
        parts = (self.kept, "masks"), (self.visible, "alpha"), (self.seen, "masks and alpha together")
        return next((cause for part, cause in parts if part.mean() <= _SOME), "")


def check_views(cameras: list[CameraInfo]) -> Iterator[Finding]:
    """Check number and sizes of the photos."""
    sizes = Counter(camera.file_size for camera in cameras)
    listed = ", ".join(f"{w} x {h} ({n})" for (w, h), n in sizes.most_common(3))
    listed += f" and {len(sizes) - 3} more sizes" if len(sizes) > 3 else ""
    count = counted(len(cameras), "photo")
    yield fine(f"{count}, none missing and all readable: {listed}")
    if len(cameras) < FEWEST_VIEWS:
        yield Finding(f"only {count}", f"take {FEWEST_VIEWS} or more; new views will look bad with fewer")
    if wide := sum(n for (width, _), n in sizes.items() if width > _WIDE):
        yield fine(f"{counted(wide, 'photo')} wider than {_WIDE} pixels, to train at that width unless -r 1 is given")


def check_photos(views: Sequence[Any], most: int, has_alpha: bool = True, place: str = "PHOTOS") -> Iterator[Finding]:
    """Find photos of which no pixel counts, and pixels that all photos share; at most `most` photos are decoded.

    has_alpha: whether their alpha counts.
    place: their folder, for messages.
    """
    looks = looks_at(views, most, has_alpha)
    for cause, remedy in _HIDDEN.items():
        if hidden := [look for look in looks if look.hidden_by == cause]:
            severity = Severity.HOPELESS if len(hidden) == len(looks) else Severity.PROBLEM
            yield Finding(
                f"{_describe_part(hidden, looks)} show nothing, as every pixel is left out by {cause}", remedy, severity
            )
    yield from check_shared([look for look in looks[:LOOKED_AT] if not look.hidden_by], Path(place))


def check_shared(looks: Sequence[Look], photos: Path) -> Iterator[Finding]:
    """Name pixels that nearly all photos of one size share. photos: their folder."""
    folders = shlex.join(map(str, (photos, photos.with_name(f"{photos.name}_masks"))))
    command = f"{typed_command('-m applications.convert.shared_masks')} {folders}"
    for size, shared in find_shared(looks).items():
        each = "each photo" if len({look.size for look in looks}) == 1 else f"each photo of {size[0]} x {size[1]}"
        text = f"{shared.mean():.0%} of {each}, {place_of(shared)}, {SHARED_TEXT}, which spoils poses and training"
        remedy = "mask it, and pass the folder of the masks as --masks of train.py"
        if has_application("convert"):
            remedy = f"write masks by `{command}`, and pass its last folder as --masks of train.py and doctor.py, or "
            remedy += "--mask_path of convert.py"
        yield Finding(text, remedy)


def find_shared(looks: Sequence[Look]) -> dict[tuple[int, int], np.ndarray]:
    """Masks (h, w) bool of the pixels that photos of one size (width, height) share, by that size."""
    found = {}
    for size in Counter(look.size for look in looks):
        group = [look for look in looks if look.size == size]
        shared = shared_pixels(np.stack([look.pixels for look in group]), np.stack([look.seen for look in group]))
        if shared.any():
            found[size] = shared
    return found


def check_size(smallest: tuple[int, int]) -> Iterator[Finding]:
    """Find images of a training's smallest size (width, height) too small."""
    if min(smallest) < SMALL:
        text = f"images of {smallest[0]}x{smallest[1]} pixels are too small to learn from"
        yield Finding(text, "give a larger --resolution")


def looks_at(views: Sequence[Any], most: int, has_alpha: bool = True) -> list[Look]:
    """Reduce photos in a random order, since every second one may be of another kind; fewer if they are large."""
    order, looks, decoded = np.random.default_rng(0).permutation(len(views)), [], 0.0
    with ThreadPoolExecutor(threads()) as pool:
        for found in pool.map(lambda number: _reduce_readable(views[number], has_alpha), order[:most]):
            if found is None:
                continue
            looks.append(found[0])
            decoded += found[1]
            if decoded > _MOST_DECODED and len(looks) >= _FEWEST:
                break  # which cancels the photos that no thread has begun
    return looks


def _reduce_readable(view: Any, has_alpha: bool) -> tuple[Look, float] | None:
    """Do as `_reduce_photo`; None for a photo that cannot be read, or is none of a file."""
    try:
        return _reduce_photo(view, has_alpha)
    except (*UNREADABLE, UserError, AttributeError):
        return None


def _reduce_photo(view: Any, has_alpha: bool) -> tuple[Look, float]:
    """Reduce a view's photo; also return the number of pixels that were decoded."""
    if (image := getattr(view, "image", None)) is None:
        with open_image(Path(view.image_path)) as image:
            size, cost = image.size, image.width * image.height * (_JPEG if image.format == "JPEG" else 1)
            pixels = _to_rgba(image)
    elif isinstance(image, Image.Image):
        pixels, size, cost = _to_rgba(image), image.size, image.width * image.height
    else:
        pixels, cost = image.pixels.permute(1, 2, 0), 0  # scene.images.store.InMemory
        size = tuple(pixels.shape[1::-1])
        rows, columns = (max(1, side // _PIXELS) for side in pixels.shape[:2])
        pixels = pixels[::rows, ::columns].cpu().numpy()
        pixels = pixels if pixels.dtype == np.uint8 else (pixels.clip(0, 1) * 255).astype(np.uint8)
    visible = np.ones(pixels.shape[:2], bool)
    if has_alpha and pixels.shape[2] == 4:
        visible = pixels[..., 3] >= _VISIBLE
    kept = np.ones_like(visible)
    if (mask := getattr(view, "mask", None)) is not None:
        whole = picture_size(mask.path)
        drawn = Image.fromarray(mask.decode(whole)[0].numpy())
        kept = np.asarray(drawn.resize(pixels.shape[1::-1], Image.Resampling.NEAREST)) >= 128
        cost += whole[0] * whole[1]
    return Look(view.image_name, pixels[..., :3], visible, kept, size), cost


def _to_rgba(image: Image.Image) -> np.ndarray:
    return shrunk(image, "RGBA" if image.has_transparency_data else "RGB", _PIXELS)


def _describe_part(part: Sequence[Look], looks: Sequence[Look]) -> str:
    names = f" ({some(sorted(look.name for look in part))})" if len(part) < len(looks) else ""
    return f"{len(part)} of the {len(looks)} photos that were looked at{names}"
