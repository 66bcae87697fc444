"""What a capture is worth: overlap, blur and brightness of its photos, and what to photograph again.

capture.json, which worker.py writes of the chosen model: of each placed photo by name its place, view and up directions
(3,), its number of points, and the points that it shares with others; and some points with their colours.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm.contrib.concurrent import thread_map

from splatting.files.color_profiles import in_srgb
from splatting.files.image_files import open_image
from splatting.files.listing import some
from splatting.host.machine import threads
from splatting.sfm.mapping import is_wrong
from splatting.sfm.video import sharpness

LEAST = 0.6  # share of the photos, below which too few are placed
_SHARED = 30  # points that a photo shares with another one that is near
FEW = 2  # such neighbours, with which a photo is weakly connected
_BLURRED = 0.3  # of the median sharpness
_SPREAD = 0.5  # stops; photos of one exposure differ by less
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
    with open_image(path) as image:
        small = in_srgb(image).convert("RGB")
        small.thumbnail((_WIDTH, _WIDTH))
        pixels = np.asarray(small)
    light = (pixels.astype(np.float32).mean() / 255) ** 2.2  # about the inverse of sRGB's curve
    return Look(sharpness(pixels), math.log2(max(float(light), 1e-4)))


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

    report: the content of that file so far. photos: of capture.json. looks: of all photos. Returns `weakly_connected`
    and `blurred`, names of photos; `brightness_spread_stops`, of the placed ones, which train; and `again`, a line for
    each thing to photograph again.
    """
    neighbours = neighbours_of(photos)
    against = {name for found in report.get("tried", [])[:1] for name in found.get("against", ())}
    weak = sorted(name for name, others in neighbours.items() if len(others) < min(FEW, len(photos) - 1))
    middle = float(np.median([look.sharpness for look in looks.values()])) if looks else 0.0
    blurred = sorted(name for name, look in looks.items() if look.sharpness < _BLURRED * middle)
    bright = [look.brightness for name, look in looks.items() if name in photos]
    spread = float(np.std(bright)) if bright else 0.0
    return {
        "weakly_connected": weak,
        "blurred": blurred,
        "brightness_spread_stops": round(spread, 3),
        "again": _again(sorted(set(report["left_out"]) - against), weak, blurred, spread),
    }


def _again(left_out: list[str], weak: list[str], blurred: list[str], spread: float) -> list[str]:
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
    if spread > _SPREAD:
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
    lines += [
        f"blur: {soft if blurred else 'no photo is blurred'}",
        f"brightness: the photos differ by {report['brightness_spread_stops']:.2f} stops",
    ]
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
