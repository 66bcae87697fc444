"""Masks of the photos: their files, and the meaning of their black parts.

White keeps a pixel and black masks it, as in COLMAP and nerfstudio. Black has one of two meanings:
ignore: the scene behind the pixel is unknown, so the pixel is left out of loss and scores.
transparent: nothing is there. The mask is the photo's alpha, and a render must show the background.
An alpha channel has these meanings, too, or none.
"""

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from PIL import Image, ImageFilter
from torch import Tensor

from groundwork.files.image_files import SUFFIXES
from groundwork.host.listing import some
from scene.images.decode import decode, grey_values, may_be_transparent, picture_size
from scene.images.find import SideFiles
from utils.system_utils import UserError

AUTO = "auto"
IGNORE = "ignore"
TRANSPARENT = "transparent"
NONE = "none"
_TAGS = ".mask", "_mask"  # of RealityScan and Metashape, behind a photo's name with or without its suffix
_FEW_VALUES = 8  # of booleans and labels
_DARK = 32  # least brightness of grey; what compression adds to black is darker
_SPREAD = ImageFilter.MinFilter(5)  # bicubic resizing mixes pixels up to 2 pixels of the coarser size apart


@dataclass(frozen=True)
class MaskOptions:
    """The user's options for masks.

    folder: in the scene folder, or absolute; empty: only the masks that the dataset names. invert: white is masked.
    meaning: IGNORE or TRANSPARENT, for mask files and alpha channels; AUTO ignores under masks and keeps alpha; NONE
    ignores under masks and drops alpha.
    """

    folder: str = ""
    invert: bool = False
    meaning: str = AUTO

    @property
    def ignore_alpha(self) -> bool:
        """True if transparent pixels of a photo are ignored."""
        return self.meaning == IGNORE

    @property
    def drop_alpha(self) -> bool:
        """True if photos count as opaque."""
        return self.meaning == NONE

    def mask(self, path: Path) -> "Mask":
        """The mask in a file."""
        return Mask(path, self.invert, TRANSPARENT if self.meaning == TRANSPARENT else IGNORE)


NO_MASKS = MaskOptions()


@dataclass(frozen=True)
class Mask:
    """A mask file, whether white is masked in it, and the meaning of masked pixels (IGNORE or TRANSPARENT).

    circle: its radius in widths of the photo; what lies outside of it, about the photo's middle, is masked, too. drawn:
    whether the file is a mask; False: it is the photo itself, of which the circle alone masks a part.
    """

    path: Path
    inverted: bool = False
    meaning: str = IGNORE
    circle: float | None = None
    drawn: bool = True
    pixel_bytes: ClassVar[int] = 1

    def decode(self, size: tuple[int, int]) -> Tensor:
        """(1,H,W) uint8 at size (width, height): 255 keeps, 0 masks.

        The values are the file's alpha if it has any, else its brightness. Which of them is white, the file's own
        values tell (`_stretch_range`). For IGNORE, half of white keeps and the result is 0 or 255. When the size
        differs from the file's, IGNORE keeps only pixels to which no masked pixel contributes when resized by
        `scene.images.decode.decode`.
        """
        grey = self._read_grey()
        if self.meaning == TRANSPARENT:
            image = Image.fromarray(np.ascontiguousarray(grey))
            image = image if image.size == size else image.resize(size, Image.Resampling.BICUBIC)
            return torch.from_numpy(np.array(image))[None]
        kept = Image.fromarray(np.where(grey >= 128, 255, 0).astype(np.uint8))
        if size[0] > kept.width:
            kept = kept.filter(_SPREAD).resize(size, Image.Resampling.BOX)
        elif size != kept.size:
            kept = kept.resize(size, Image.Resampling.BOX).filter(_SPREAD)
        return torch.from_numpy(np.where(np.asarray(kept) == 255, np.uint8(255), np.uint8(0)))[None]

    def _read_grey(self) -> np.ndarray:
        """The values (H, W) uint8 of the file, of which 255 keeps."""
        if self.drawn:
            grey = _stretch_range(grey_values(self.path), lossy=self.path.suffix.lower() in (".jpg", ".jpeg"))
            grey = 255 - grey if self.inverted else grey
        else:
            grey = np.full(picture_size(self.path)[::-1], 255, np.uint8)
        if self.circle is not None:
            y, x = (np.arange(side) + 0.5 - side / 2 for side in grey.shape)
            grey = np.where(y[:, None] ** 2 + x**2 <= (self.circle * len(x)) ** 2, grey, np.uint8(0))
        return grey


@dataclass(frozen=True)
class Opaque:
    """A photo without its alpha."""

    path: Path
    pixel_bytes: ClassVar[int] = 3

    def decode(self, size: tuple[int, int]) -> Tensor:
        """(3,H,W) uint8 as `scene.images.decode.decode` gives it for a photo that never had alpha."""
        return decode(self.path, size, opaque=True)


@dataclass(frozen=True)
class Cutout:
    """A photo whose alpha is multiplied by a TRANSPARENT mask."""

    path: Path
    mask: Mask
    pixel_bytes: ClassVar[int] = 4

    def decode(self, size: tuple[int, int]) -> Tensor:
        """(4,H,W) uint8 as `scene.images.decode.decode` gives it, with straight alpha."""
        full = picture_size(self.path)
        image = Image.fromarray(add_alpha(decode(self.path, full), self.mask.decode(full)).permute(1, 2, 0).numpy())
        # Pillow weights colours by alpha when it resizes, so masked colours do not bleed in.
        image = image if full == size else image.resize(size, Image.Resampling.BICUBIC)
        return torch.from_numpy(np.asarray(image).transpose(2, 0, 1).copy())


def add_alpha(pixels: Tensor, mask: Tensor) -> Tensor:
    """Image (4,H,W) uint8 of an image (3 or 4,H,W) uint8, with its alpha multiplied by a mask (1,H,W) uint8."""
    if len(pixels) == 4:
        mask = (pixels[3:].int() * mask.int() + 127).div(255, rounding_mode="floor").to(torch.uint8)
    return torch.cat([pixels[:3], mask])


def _stretch_range(values: np.ndarray, lossy: bool) -> np.ndarray:
    """A mask's values (H, W), uint8 or uint16, as uint8 in which white is 255.

    Files below half of their range are dark masks, or no grey at all. With few different values these are booleans or
    labels, and all but 0 is white. With more they are grey if the brightest part is larger than what lies between.
    Others, as noise in a black JPEG, stay dark.
    """
    full, top = np.iinfo(values.dtype).max, int(values.max())
    if top > full // 2:
        return values if full == 255 else ((values.astype(np.int32) + 128) // 257).astype(np.uint8)
    counts = np.bincount(values.ravel(), minlength=top + 1)
    if not lossy and np.count_nonzero(counts) <= _FEW_VALUES:
        return np.where(values > 0, 255, 0).astype(np.uint8)
    plateau, between = counts[3 * top // 4 :].sum(), counts[top // 4 + 1 : 3 * top // 4].sum()
    if plateau > between and top >= _DARK:
        return (values.astype(np.int64) * 255 // top).astype(np.uint8)
    return values if full == 255 else (values // 257).astype(np.uint8)


def find_masks(
    scene: Path, names: Sequence[str], options: MaskOptions, photos: Sequence[Path], images: str = ""
) -> list[Mask | None]:
    """The mask of each photo, as `SideFiles` finds it by name.

    A mask is called `<name>`, `<name>.png` (as in COLMAP), by the name with another suffix, or by either with .mask or
    _mask behind. names: relative to the folder `images` of the scene. All None without a folder in the options.
    UserError when the folder is missing or no photo has a mask in it. A message names photos that have none.
    """
    if not options.folder:
        if options.invert:
            raise UserError("--invert_masks has no masks to invert; name their folder with --masks, or leave it out")
        return [None] * len(names)
    folder = scene / options.folder
    if not folder.is_dir():
        raise UserError(f"no folder {folder} for --masks; name a folder in the scene folder, or give an absolute path")
    files = SideFiles(folder, names, photos, scene / images)
    found = [files.find(place, mask_names) for place in range(len(names))]
    lacking = [name for name, path in zip(names, found, strict=True) if path is None]
    if len(lacking) == len(names):
        if files.photos_met:
            met = some(sorted(map(str, files.photos_met)))
            raise UserError(
                f"{folder} (--masks) contains the photos ({met}) and no masks; name the folder of the masks, or use "
                "the photos' alpha channel with --mask_meaning ignore"
            )
        raise UserError(
            f"no mask in {folder} (--masks) belongs to a photo: looked for {names[0]}, {names[0]}.png and other "
            f"suffixes, found {some(sorted(path.name for path in folder.iterdir()))}; name masks like the photos"
        )
    if lacking:
        said = f"{len(lacking)} of {len(names)} photos have no mask; all their pixels count: {some(lacking)}"
        print(said, file=sys.stderr)
    files.report_elsewhere("masks")
    return [None if path is None else options.mask(path) for path in found]


def mask_names(name: str) -> list[str]:
    """File names of the mask of a photo."""
    bases = name, os.path.splitext(name)[0]
    usual = [name, f"{name}.png", *(bases[1] + suffix for suffix in SUFFIXES)]
    return usual + [base + tag + suffix for base in bases for tag in _TAGS for suffix in SUFFIXES]


def check_masks(pictures: Sequence[tuple[Path, Mask | None]], options: MaskOptions) -> None:
    """UserError for a mask in the folder of the options that several photos share, and for nothing to ignore.

    pictures: photos and masks of all views.
    """
    refuse_nothing_to_ignore(pictures, options)
    owners: dict[Path, set[str]] = {}
    for photo, mask in pictures:
        if mask and options.folder:
            owners.setdefault(mask.path, set()).add(str(photo))
    shared = [(mask, sorted(photos)) for mask, photos in owners.items() if len(photos) > 1]
    if shared:
        mask, photos = shared[0]
        raise UserError(
            f"{len(shared)} masks belong to several photos each, the first is {mask} for {some(photos)}; put masks "
            "into the sub-folders of the photos, with the photos' names and .png appended"
        )


def refuse_nothing_to_ignore(pictures: Sequence[tuple[Path, Mask | None]], options: MaskOptions) -> None:
    """UserError for --mask_meaning ignore if no photo has a mask or an alpha channel. pictures: photos and masks."""
    if options.meaning == IGNORE and not any(mask or may_be_transparent(path) for path, mask in pictures):
        raise UserError(
            "--mask_meaning ignore has nothing to ignore: no masks are named, and no photo has an alpha channel; "
            "name the folder of masks with --masks, or leave --mask_meaning out"
        )
