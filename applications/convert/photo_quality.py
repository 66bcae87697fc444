"""Blur and brightness of the photos of a capture, which applications/convert/checks.py judges.

capture.json, which worker.py writes of the chosen model: of each placed photo by name its place, view and up directions
(3,), its number of points, and the points that it shares with others; and some points with their colours.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from applications.convert.checks import SHARED, Look
from applications.convert.layout import Layout
from groundwork.host.progress import in_threads
from scene.checks.photo_files import sharpness, small
from scene.images.exposures import exposures
from scene.readers.colmap import read_model


def measure_looks(folder: Path, names: Sequence[str]) -> dict[str, Look]:
    """Measure the sharpness and the brightness of photos in a folder; return them by name."""
    found = in_threads(lambda name: _measure_look(folder / name), names, desc="Looking at photos")
    return dict(zip(names, found, strict=True))


def _measure_look(path: Path) -> Look:
    pixels = small(path)
    light = (pixels.astype(np.float32).mean() / 255) ** 2.2  # about the inverse of sRGB's curve
    return Look(sharpness(pixels), math.log2(max(float(light), 1e-4)))


def compare_brightness(looks: Mapping[str, Look], layout: Layout) -> dict[str, Look]:
    """Replace the brightness of placed photos by that of the points which they share with other photos.

    So a photo of a dark wall does not count as underexposed. A photo that shares few points has brightness NaN.
    """
    model = read_model(layout.sparse / "0", with_2d_points=True)
    images = [image for image in model.images if image.name in looks]
    sizes = [(model.cameras[image.camera_id].width, model.cameras[image.camera_id].height) for image in images]
    seen = in_threads(
        lambda image, size: _read_colors(layout.images / image.name, image.xys / size, image.point3D_ids),
        images, sizes, desc="Comparing photos",
    )  # fmt: skip
    enough = [number for number, (points, _) in enumerate(seen) if len(points) >= SHARED]
    found = {image.name: looks[image.name]._replace(brightness=math.nan) for image in images}
    if len(enough) > 1:
        points, colors = zip(*(seen[number] for number in enough), strict=True)
        brighter, middle = exposures(colors, points), np.median([look.brightness for look in looks.values()])
        for number, bright in zip(enough, brighter - np.median(brighter), strict=True):
            name = images[number].name
            found[name] = found[name]._replace(brightness=middle + bright)
    return {**looks, **found}


def _read_colors(path: Path, places: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers (K,) of the points that a photo shows, and their colours (K, 3) in [0, 1].

    places: (P, 2), parts of the photo's width and height.
    numbers: (P,) of points, negative where there is none.
    """
    pixels = small(path)
    size = pixels.shape[1::-1]
    places = places * size
    inside = (numbers >= 0) & (places >= 0).all(1) & (places < size).all(1)  # none of what is not finite
    column, row = places[inside].astype(int).T
    return numbers[inside], pixels[row, column] / 255
