"""Images as 8-bit PNGs, and folders of them that are named by number."""

import re
from pathlib import Path

import torch
from PIL import Image

from utils.system_utils import atomic_write


def to_bytes(image: torch.Tensor) -> torch.Tensor:
    """An image (3, H, W), float in [0, 1] or already uint8, as (H, W, 3) uint8, halves rounded up."""
    if image.dtype != torch.uint8:
        image = (image.clamp(0, 1) * 255 + 0.5).to(torch.uint8)
    return image.permute(1, 2, 0).contiguous().cpu()


def save_png(image: torch.Tensor, path: Path) -> None:
    """Write an image as `to_bytes` takes it; the file is written whole or not at all."""
    with atomic_write(path) as temporary:
        Image.fromarray(to_bytes(image).numpy()).save(temporary)


def remove_leftovers(folder: Path, count: int) -> None:
    """Delete numbered PNGs beyond the first `count`, which an earlier run with more views has left."""
    for file in folder.glob("*.png"):
        if re.fullmatch(r"\d{5,}", file.stem) and int(file.stem) >= count:
            file.unlink()
