"""Blur and brightness of the photos of a capture, which splatting/findings/capture.py judges.

capture.json, which worker.py writes of the chosen model: of each placed photo by name its place, view and up directions
(3,), its number of points, and the points that it shares with others; and some points with their colours.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.ndimage import uniform_filter
from tqdm.contrib.concurrent import thread_map

from scene.images.exposures import exposures, levels
from scene.readers.colmap import read_model
from splatting.files.color_profiles import in_srgb
from splatting.files.image_files import open_image
from splatting.findings.capture import SHARED, Look
from splatting.host.machine import threads
from splatting.sfm.layout import Layout
from splatting.sfm.video import sharpness

_TEXTURE, _OUTLIER = 9, 3.0  # pixels around a point that tell sharpness, and what is no sharpness (logarithm to 2)
_WIDTH = 640  # pixels at which photos are compared, as sharpness depends on it


def looks_of(folder: Path, names: Sequence[str]) -> dict[str, Look]:
    """Sharpness and brightness of photos in a folder, by name."""
    found = thread_map(lambda name: _look(folder / name), names, max_workers=threads(), desc="Looking at photos",
                       dynamic_ncols=True)  # fmt: skip
    return dict(zip(names, found, strict=True))


def _look(path: Path) -> Look:
    pixels = _small(path)
    light = (pixels.astype(np.float32).mean() / 255) ** 2.2  # about the inverse of sRGB's curve
    return Look(sharpness(pixels), math.log2(max(float(light), 1e-4)))


def compared(looks: Mapping[str, Look], layout: Layout) -> dict[str, Look]:
    """Looks of photos, those of the placed ones by the points that they share with others.

    A photo of a dark wall is neither blurred nor of another exposure. One that shares few points is taken as sharp, and
    its brightness as unknown, NaN.
    """
    model = read_model(layout.sparse / "0", with_2d_points=True)
    images = [image for image in model.images if image.name in looks]
    sizes = [(model.cameras[image.camera_id].width, model.cameras[image.camera_id].height) for image in images]
    seen = thread_map(
        lambda image, size: _at_points(layout.images / image.name, image.xys / size, image.point3D_ids),
        images, sizes, max_workers=threads(), desc="Comparing photos", dynamic_ncols=True,
    )  # fmt: skip
    middle = Look(*np.median(list(looks.values()), axis=0)) if looks else Look(1, 0)
    enough = [number for number, (points, _, _) in enumerate(seen) if len(points) >= SHARED]
    found = {image.name: Look(middle.sharpness, math.nan) for image in images}
    if len(enough) > 1:
        points, colors, textures = zip(*(seen[number] for number in enough), strict=True)
        sharper, brighter = levels(textures, points, _OUTLIER), exposures(colors, points)
        sharper, brighter = sharper - np.median(sharper), brighter - np.median(brighter)
        for number, sharp, bright in zip(enough, sharper, brighter, strict=True):
            found[images[number].name] = Look(middle.sharpness * 2**sharp, middle.brightness + bright)
    return {**looks, **found}


def _at_points(path: Path, places: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the points (K,) that a photo shows their numbers, colours (K,3), and logarithms of contrast (K,).

    places: (K,2), in parts of the photo's width and height. numbers: negative where there is no point.
    """
    pixels = _small(path)
    size = pixels.shape[1::-1]
    places = (places * size).astype(int)
    inside = (numbers >= 0) & (places >= 0).all(1) & (places < size).all(1)
    column, row = places[inside].T
    grey = pixels.mean(2, dtype=np.float32) + 1
    steps = sum(np.square(change) for change in np.gradient(grey))
    contrast = (uniform_filter(steps, _TEXTURE) + 1)[row, column] / uniform_filter(grey, _TEXTURE)[row, column] ** 2
    return numbers[inside], pixels[row, column] / 255, np.log2(contrast)


def _small(path: Path) -> np.ndarray:
    with open_image(path) as image:
        small = in_srgb(image).convert("RGB")
        small.thumbnail((_WIDTH, _WIDTH))
        return np.asarray(small)
