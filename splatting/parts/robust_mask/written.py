"""What a training has left out of its photos, as mask files and as a picture of the worst."""

import os
import shutil
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

from scene.images.find import names_below
from splatting.evaluation.renders import WIDEST, WORST, sheet
from splatting.files.image_files import dimmed, to_bytes
from splatting.host.listing import some
from splatting.parts.robust_mask.residuals import Residuals
from utils.image_utils import as_float
from utils.system_utils import atomic_write

FOLDER = "robust_masks"  # of a model folder: mask files of what was masked at the end
PICTURE = "robust_masks.png"  # photos of which most is left out


def write_masks(masks: Residuals, model_path: str | os.PathLike, source_path: str, background: Tensor) -> str:
    """Write FOLDER and PICTURE into a model folder, in place of those of an earlier training; say what they show."""
    model, shares = Path(model_path), {}
    folder, picture = model / FOLDER, model / PICTURE
    shutil.rmtree(folder, ignore_errors=True)
    picture.unlink(missing_ok=True)
    given = [camera.image_name for camera in masks.cameras]
    names = dict(zip(given, names_below(given, Path(source_path)), strict=True))
    for camera in masks.cameras:
        if (counts := masks.counted(camera)) is None:
            continue
        shares[camera.image_name] = 1 - float(counts.float().mean())
        with atomic_write(folder / f"{names[camera.image_name]}.png") as temporary:
            Image.fromarray(counts[0].to(torch.uint8).mul(255).cpu().numpy()).save(temporary)
    shares = dict(sorted(shares.items(), key=lambda named: -named[1]))
    if shares:
        _draw(masks, shares, background, picture)
    views = len(masks.cameras)
    most = [f"{name} ({share:.0%})" for name, share in shares.items()]
    text = f"--robust_mask leaves out {sum(shares.values()) / views:.1%} of the pixels"
    text += f", in {len(shares)} of {views} photos"
    return text + (f", most in {some(most)}; {folder} shows them" if most else "")


def _draw(masks: Residuals, shares: dict[str, float], background: Tensor, path: Path) -> None:
    """Draw photos beside themselves with darker masked parts. shares: of what is masked, the largest first."""
    rows, cameras = [], {camera.image_name: camera for camera in masks.cameras}
    for name in list(shares)[:WORST]:
        photo = as_float(cameras[name].target(background))
        both = photo, dimmed(photo, masks.counted(cameras[name]))
        images = [Image.fromarray(to_bytes(image).numpy()) for image in both]
        rows.append(list(zip((name, f"{shares[name]:.0%}"), images, strict=True)))
    with atomic_write(path) as temporary:
        sheet(("photo", "left out: dark"), rows, WIDEST).save(temporary)
