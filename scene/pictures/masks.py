"""Masks beside the pictures: which files, and what their black parts mean.

White keeps and black masks, as COLMAP and nerfstudio have it. Two meanings of black:
ignore: nobody knows what should be seen there, so such pixels are left out of loss and scores.
transparent: nothing is there. The mask is the picture's alpha, and the background is what should be seen there.
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

from scene.pictures.decode import decode, may_be_transparent, picture_size
from scene.pictures.find import FileIndex
from utils.files.image_files import SUFFIXES
from utils.files.listing import some
from utils.system_utils import UserError

AUTO = "auto"
IGNORE = "ignore"
TRANSPARENT = "transparent"
_REACH = ImageFilter.MinFilter(5)  # as far as bicubic resizing mixes: 2 pixels of the coarser size


@dataclass(frozen=True)
class MaskOptions:
    """What the user says of masks.

    folder: in the scene folder, or absolute; empty: none but those that the dataset names. invert: white masks.
    meaning: AUTO (mask files: ignore; alpha channels: transparent), IGNORE or TRANSPARENT (both).
    """

    folder: str = ""
    invert: bool = False
    meaning: str = AUTO

    @property
    def ignore_alpha(self) -> bool:
        """Whether what is transparent in a picture is to be ignored."""
        return self.meaning == IGNORE

    def mask(self, path: Path) -> "Mask":
        """The mask in a file."""
        return Mask(path, self.invert, TRANSPARENT if self.meaning == TRANSPARENT else IGNORE)


NO_MASKS = MaskOptions()


@dataclass(frozen=True)
class Mask:
    """A mask's file, whether white masks in it, and what that means (IGNORE or TRANSPARENT)."""

    path: Path
    inverted: bool = False
    meaning: str = IGNORE
    pixel_bytes: ClassVar[int] = 1

    def decode(self, size: tuple[int, int]) -> Tensor:
        """(1,H,W) uint8 at size (width, height): 255 keeps, 0 masks.

        The file's alpha where it has any, else its brightness; where its values are 0 and 1 (of 255), as of True and
        False saved as bytes, 1 means white. IGNORE knows no other values: brightness 128 or more keeps. At another size
        than the file's only what no masked pixel has a say in is kept, when pictures are resized as
        `scene.pictures.decode.decode` does it.
        """
        pixels = decode(self.path, picture_size(self.path)).numpy()
        grey = pixels[3] if len(pixels) == 4 else pixels.max(axis=0)
        if grey.max() == 1:
            grey = grey * np.uint8(255)
        if self.inverted:
            grey = 255 - grey
        if self.meaning == TRANSPARENT:
            return _resized(grey, size, Image.Resampling.BICUBIC)
        kept = Image.fromarray(np.where(grey >= 128, 255, 0).astype(np.uint8))
        if size[0] > kept.width:
            kept = kept.filter(_REACH).resize(size, Image.Resampling.BOX)
        elif size != kept.size:
            kept = kept.resize(size, Image.Resampling.BOX).filter(_REACH)
        return torch.from_numpy(np.where(np.asarray(kept) == 255, np.uint8(255), np.uint8(0)))[None]


def _resized(grey: np.ndarray, size: tuple[int, int], resampling: Image.Resampling) -> Tensor:
    image = Image.fromarray(np.ascontiguousarray(grey))
    image = image if image.size == size else image.resize(size, resampling)
    return torch.from_numpy(np.array(image))[None]


@dataclass(frozen=True)
class Cutout:
    """A picture with a TRANSPARENT mask as its alpha, times the alpha of its own."""

    path: Path
    mask: Mask
    pixel_bytes: ClassVar[int] = 4

    def decode(self, size: tuple[int, int]) -> Tensor:
        """(4,H,W) uint8 as `scene.pictures.decode.decode` gives it, with straight alpha."""
        full = picture_size(self.path)
        image = Image.fromarray(add_alpha(decode(self.path, full), self.mask.decode(full)).permute(1, 2, 0).numpy())
        # Pillow weighs colours by alpha when it resizes, so what is masked does not bleed in.
        image = image if full == size else image.resize(size, Image.Resampling.BICUBIC)
        return torch.from_numpy(np.asarray(image).transpose(2, 0, 1).copy())


def add_alpha(pixels: Tensor, mask: Tensor) -> Tensor:
    """Picture (3 or 4,H,W) uint8 and mask (1,H,W) uint8 to a picture (4,H,W) whose alpha is the product of both."""
    if len(pixels) == 4:
        mask = (pixels[3:].int() * mask.int() + 127).div(255, rounding_mode="floor").to(torch.uint8)
    return torch.cat([pixels[:3], mask])


def find_masks(scene: Path, names: Sequence[str], options: MaskOptions) -> list[Mask | None]:
    """The mask of each picture, by name: `<name>`, `<name>.png` (COLMAP's way), or the name with another suffix.

    None for all without a folder in the options. UserError when the folder is missing or has no mask for any of them;
    where some lack one, a line says so.
    """
    if not options.folder:
        if options.invert:
            raise UserError("--invert_masks has no masks to invert; name their folder with --masks, or leave it out")
        return [None] * len(names)
    folder = scene / options.folder
    if not folder.is_dir():
        raise UserError(f"no folder {folder} for --masks; name one in the scene folder, or give its whole path")
    index = FileIndex(folder)
    found = [_find(index, name) for name in names]
    lacking = [name for name, path in zip(names, found, strict=True) if path is None]
    if len(lacking) == len(names):
        raise UserError(
            f"no mask in {folder} (--masks) belongs to a picture: looked for {names[0]}, {names[0]}.png and other "
            f"suffixes, found {some(sorted(path.name for path in folder.iterdir()))}; name masks as the pictures"
        )
    if lacking:
        print(f"{len(lacking)} of {len(names)} pictures have no mask and count whole: {some(lacking)}", file=sys.stderr)
    return [None if path is None else options.mask(path) for path in found]


def refuse_nothing_to_ignore(pictures: Sequence[tuple[Path, Mask | None]], options: MaskOptions) -> None:
    """UserError for --mask_meaning ignore where no picture (its file, its mask) has a mask or an alpha channel."""
    if options.meaning == IGNORE and not any(mask or may_be_transparent(path) for path, mask in pictures):
        raise UserError(
            "--mask_meaning ignore has nothing to ignore: no masks are named, and no picture has an alpha channel; "
            "name the folder of masks with --masks, or leave it out"
        )


def _find(index: FileIndex, name: str) -> Path | None:
    stem = os.path.splitext(name)[0]
    return index.find(name, f"{name}.png", *(stem + suffix for suffix in SUFFIXES))
