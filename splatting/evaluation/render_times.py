"""render_times.json: the time of each view of a rendered set, and the facts needed to compare it."""

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from splatting.files.json_files import write_json
from splatting.host.machine import device_name

NAME = "render_times.json"


def summarise(
    seconds: Sequence[float], sizes: Sequence[tuple[int, int]], gaussians: int, antialiasing: bool, device: torch.device
) -> dict[str, Any]:
    """The file's content, from `seconds` and `sizes` (width, height; pixels) of the views in the order of their PNGs.

    fps: frames per second at the median. sizes: each size once. threads: those of the CPU, whatever the device.
    """
    median = statistics.median(seconds)
    return {
        "antialiasing": antialiasing,
        "device": device_name(device),
        "fps": round(1 / median, 3),
        "gaussians": gaussians,
        "median_ms": round(1e3 * median, 4),
        "milliseconds": {f"{index:05d}.png": round(1e3 * value, 4) for index, value in enumerate(seconds)},
        "sizes": sorted(set(sizes)),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
    }


def write(folder: Path, summary: dict[str, Any]) -> None:
    """Write the result of `summarise` into `folder`."""
    write_json(folder / NAME, summary)
