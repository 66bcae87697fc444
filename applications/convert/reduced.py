"""Smaller copies of photos, in which features are found, and their model brought back to the size of the photos.

The time of features grows with the pixels, and the error of the poses hardly falls with more of them. COLMAP decodes
photos one after another, which for large ones takes longer than their features.
"""

import os
import shutil
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image

from groundwork.files.image_files import open_image

FEW = 100  # photos
LONGEST_OF_FEW, LONGEST = 1600, 800  # pixels of a copy's longer side
ENLARGED = 1280  # to which small photos are enlarged, which have few features
ABOUT = 1.05  # times that, which photos may have that stay as they are
_QUALITY = 95  # of JPEG
_THREADS = 16  # each may hold a photo of 50 megapixels
_ROUNDED = 1.5  # pixels by which a smaller copy's side may differ from the photo's proportions


def choose_longest_side(count: int) -> int:
    """Pixels of the longer side on which features of so many photos are found."""
    return LONGEST_OF_FEW if count <= FEW else LONGEST


def reduce_photos(photos: Path, target: Path, names: Sequence[str], longest: int, size: tuple[int, int] | None) -> None:
    """Write copies of photos into a folder, with their EXIF data but for TIFF; photos that are small enough are linked.

    size: width and height, if they are to be those of a camera that is known.
    """
    with ThreadPoolExecutor(min(os.cpu_count() or 1, _THREADS)) as pool:
        list(pool.map(partial(_reduce_photo, photos, target, longest, size), names))


def _reduce_photo(photos: Path, target: Path, longest: int, size: tuple[int, int] | None, name: str) -> None:
    """Write the copy of one photo for `reduce_photos`, unless there is one.

    photos, target: folders of the photos and of the copies.
    longest: pixels of the longer side, at most.
    size: width and height of the copy where they are given.
    name: of the photo, in both folders.
    """
    source, copy = photos / name, target / name
    if copy.exists():
        return
    copy.parent.mkdir(parents=True, exist_ok=True)
    with open_image(source) as image:
        scale = min(1.0, longest / max(image.size))
        wanted = size or tuple(round(side * scale) for side in image.size)
        if wanted == image.size or (size is None and max(image.size) <= ABOUT * longest):
            try:
                os.link(source, copy)
            except OSError:
                shutil.copyfile(source, copy)
            return
        # The data of a TIFF are those of its own strips, too.
        options = {"compression": "raw"} if image.format == "TIFF" else {"exif": image.getexif()}
        image.draft("RGB", wanted)  # a JPEG is decoded at about this size
        if image.mode.startswith("I"):  # 16 bits, which Pillow would cut off at 255
            image = Image.fromarray((np.asarray(image) >> 8).astype(np.uint8))
        small = image.convert("RGB").resize(wanted, Image.Resampling.LANCZOS)
    temporary = copy.with_name(f".{os.getpid()}.{copy.name}")
    small.save(temporary, **options, **({"quality": _QUALITY} if copy.suffix.lower() in (".jpg", ".jpeg") else {}))
    temporary.replace(copy)


def _refuse_other_shape(image: pycolmap.Image, width: int, height: int) -> None:
    """End the program where a photo has not the proportions of its camera, as one that was turned."""
    camera = image.camera
    rounded = _ROUNDED * max(1.0, width / camera.width)
    if abs(width * camera.height / camera.width - height) > rounded:
        of_camera = f"{camera.width} x {camera.height}"
        sys.exit(f"the photo {image.name} has {width} x {height} pixels, but its camera in the model {of_camera}")


def read_enlarged(path: str, photos: Path) -> pycolmap.Reconstruction:
    """Read a model, and bring its cameras and image points to the size of its photos."""
    model = pycolmap.Reconstruction(path)
    sizes: dict[int, tuple[int, int]] = {}
    for number in model.reg_image_ids():
        image = model.images[number]
        if image.camera_id not in sizes and (photos / image.name).is_file():
            with open_image(photos / image.name) as photo:
                sizes[image.camera_id] = photo.size
            _refuse_other_shape(image, *photo.size)
    changed = False
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        width, height = sizes.get(image.camera_id, (camera.width, camera.height))
        if (width, height) != (camera.width, camera.height):
            changed, factor = True, np.array([width / camera.width, height / camera.height])
            for point in image.points2D:
                point.xy = point.xy * factor
    for number, size in sizes.items():
        if size != (model.cameras[number].width, model.cameras[number].height):
            model.cameras[number].rescale(*size)
    if changed:
        model.update_point_3d_errors()
    return model
