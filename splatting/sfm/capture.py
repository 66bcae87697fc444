"""What a capture is worth: overlap, blur and brightness of its photos, and what to photograph again.

capture.json, which worker.py writes of the chosen model: of each placed photo by name its place, view and up directions
(3,), its number of points, and the points that it shares with others; and some points with their colours.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter
from tqdm.contrib.concurrent import thread_map

from scene.images.exposures import EXPOSURES, exposures, levels
from scene.readers.colmap import read_model
from splatting.files.color_profiles import in_srgb
from splatting.files.image_files import open_image
from splatting.host.listing import some
from splatting.host.machine import threads
from splatting.sfm.layout import Layout
from splatting.sfm.mapping import is_wrong
from splatting.sfm.video import sharpness

LEAST = 0.6  # share of the photos, below which too few are placed
_SHARED = 30  # points that a photo shares with another one that is near
FEW = 2  # such neighbours, with which a photo is weakly connected
_BLURRED = 0.3  # of the median sharpness
_TEXTURE, _OUTLIER = 9, 3.0  # pixels around a point that tell sharpness, and what is no sharpness (logarithm to 2)
_EXPOSURES = "--appearance ppisp"  # of train.py, for photos that differ by more
_WIDTH = 640  # pixels at which photos are compared, as sharpness depends on it


class Look(NamedTuple):
    """A photo's sharpness (mean squared difference of neighbours) and brightness (stops)."""

    sharpness: float
    brightness: float


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
    enough = [number for number, (points, _, _) in enumerate(seen) if len(points) >= _SHARED]
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


def neighbours_of(photos: Mapping[str, Mapping[str, Any]]) -> dict[str, list[str]]:
    """The photos with which each placed photo shares enough points, most first."""
    return {
        name: [other for other, count in sorted(photo["shared"].items(), key=lambda one: -one[1]) if count >= _SHARED]
        for name, photo in photos.items()
    }


def findings(
    report: Mapping[str, Any], photos: Mapping[str, Mapping[str, Any]], looks: Mapping[str, Look]
) -> dict[str, Any]:
    """What a capture is worth, for convert_report.json.

    report: the content of that file so far. photos: of capture.json. looks: of all photos, `compared`. Returns
    `weakly_connected` and `blurred`, names of photos; `brightness_spread_stops`, of the placed ones, which train, or
    None; and `again`, a line for each thing to photograph again.
    """
    neighbours = neighbours_of(photos)
    against = {name for found in report.get("tried", [])[:1] for name in found.get("against", ())}
    weak = sorted(name for name, others in neighbours.items() if len(others) < min(FEW, len(photos) - 1))
    middle = float(np.median([look.sharpness for look in looks.values()])) if looks else 0.0
    blurred = sorted(name for name, look in looks.items() if look.sharpness < _BLURRED * middle)
    bright = [look.brightness for name, look in looks.items() if name in photos and math.isfinite(look.brightness)]
    spread = round(float(np.std(bright)), 3) if bright else None
    return {
        "weakly_connected": weak,
        "blurred": blurred,
        "brightness_spread_stops": spread,
        "again": _again(sorted(set(report["left_out"]) - against), weak, blurred, spread),
    }


def _again(left_out: list[str], weak: list[str], blurred: list[str], spread: float | None) -> list[str]:
    lines = []
    if left_out:
        lines.append(
            f"what {some(left_out)} show, if it belongs to the scene: take photos on the way from there to the others, "
            "each overlapping the one before by 60 to 80 %"
        )
    if weak:
        lines.append(f"around {some(weak)}: fewer than {FEW} other photos share points with each; take more there")
    if blurred:
        lines.append(f"{some(blurred)}: blurred; hold the camera still, or add light")
    if spread and spread > EXPOSURES:
        lines.append(
            f"with a fixed exposure, if you can: the photos' brightness differs by {spread:.1f} stops; train these "
            f"with {_EXPOSURES}"
        )
    return lines


def lines_of(report: Mapping[str, Any]) -> list[str]:
    """The report of a capture in a few lines, after its summary."""
    weak, blurred = report["weakly_connected"], report["blurred"]
    lines = []
    if weak or not unusable(report):
        few = f"{len(weak)} of {report['registered']} photos weakly connected ({some(weak)})"
        lines.append(f"overlap: {few if weak else 'no photo is weakly connected'}")
    soft = f"{len(blurred)} of {report['photos']} photos blurred ({some(blurred)})"
    lines.append(f"blur: {soft if blurred else 'no photo is blurred'}")
    if (spread := report["brightness_spread_stops"]) is not None:
        lines.append(f"brightness: the photos differ by {spread:.2f} stops")
    lines += [f"photograph again {line}" for line in report["again"]]
    return lines


def training_options(report: Mapping[str, Any]) -> str:
    """Options of train.py that lines of the report name; "" if there are none."""
    return _EXPOSURES if any(_EXPOSURES in line for line in report["again"]) else ""


def unusable(report: Mapping[str, Any]) -> str | None:
    """What to say where too few photos are placed, or where they contradict each other."""
    placed, count = report["registered"], report["photos"]
    if report.get("tried") and is_wrong(report["tried"][0]):
        return "no way of mapping found poses that agree with the photos' matches, so do not train on this scene"
    if placed >= LEAST * count:
        return None
    return (
        f"only {placed} of {count} photos are placed, so the scene is incomplete; the lines above say what to "
        "photograph again"
    )
