"""Write masks of the pixels that nearly all photos in a folder share, such as black corners or a caption.

python -m applications.convert.shared_masks PHOTOS MASKS

The masks are for --masks of train.py and --mask_path of convert.py: PNGs with the photos' names and .png appended.
"""

from argparse import ArgumentParser
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import binary_dilation

from applications.convert.images import read_upright_size
from applications.convert.inputs import sort_inputs
from scene.checks.photos import Photo, find_shared, looks_at
from scene.checks.shared_pixels import BORDER
from utils.system_utils import UserError, atomic_write, run_cli


def write_shared_masks(photos: Path, masks: Path) -> int:
    """Write the masks into a folder, and return their number. UserError if there is nothing to mask."""
    if not photos.is_dir():
        raise UserError(f"no folder {photos}; name the folder of the photos")
    if masks.resolve().is_relative_to(photos.resolve()):
        raise UserError(f"masks in {masks} would count as photos of {photos}; name a folder beside it")
    names = sort_inputs(photos, skip_unreadable=True).photos
    shared = find_shared(looks_at([Photo(name, photos / name) for name in names], len(names)))
    sizes = {name: read_upright_size(photos / name) for name in names}
    named = [name for name in names if sizes[name] in shared]
    if not named:
        raise UserError(f"no pixels that nearly all photos in {photos} share were found; nothing is written")
    for name in named:
        kept = np.where(binary_dilation(shared[sizes[name]], iterations=BORDER), np.uint8(0), np.uint8(255))
        path = masks / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as temporary:
            Image.fromarray(kept).resize(sizes[name], Image.Resampling.NEAREST).save(temporary, "PNG")
    return len(named)


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = ArgumentParser(prog="python -m applications.convert.shared_masks", description=__doc__.splitlines()[0])
    parser.add_argument("photos", type=Path, help="folder of the photos")
    parser.add_argument("masks", type=Path, help="folder for the masks")
    args = parser.parse_args(argv)
    print(f"{write_shared_masks(args.photos, args.masks)} masks in {args.masks}")


if __name__ == "__main__":
    run_cli(main)
