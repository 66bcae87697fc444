"""Photo, render and error of a run's test views, small enough to be embedded in the report."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from evaluation.blocks import Comparison
from evaluation.contact_sheet import GAIN, error_image, shrunk
from evaluation.model_folder import counted_picture, load_scores, picture_name
from utils.files.json_files import read_json

OF_A_RUN = 24  # test views at most, evenly spread
OF_A_REPORT = 96  # at about 0.1 MB each
WIDEST = 480  # pixels
_QUALITY = 85


def comparisons(run: dict[str, Any], output: Path, most: int) -> list[Comparison]:
    """Return at most `most` scored test views of a run's last scored iteration, in their order.

    Pixels that do not count are white in the pictures and black in the error. UserError for a damaged picture.
    """
    model = output / run["model"]
    method = f"ours_{run['final_iteration']}"
    scores = load_scores(model, method)[1]["PSNR"]
    names = sorted(name for name, value in scores.items() if value is not None)
    if not names:
        return []
    picked = np.unique(np.linspace(0, len(names) - 1, most).round().astype(int))
    cameras = _cameras(model)
    views = []
    for name in (names[i] for i in picked):
        photo, render = (counted_picture(model / "test" / method, side, name) for side in ("gt", "renders"))
        caption = f"{picture_name(cameras, name)}: {scores[name]:.2f} dB; photo and render, and their error x {GAIN}"
        views.append(Comparison(caption, *map(_jpeg, (photo, render, error_image(photo, render)))))
    return views


def _cameras(model: Path) -> Any:
    try:
        return read_json(model / "cameras.json")
    except (OSError, ValueError, RecursionError):
        return None


def _jpeg(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    shrunk(image, WIDEST).convert("RGB").save(buffer, "JPEG", quality=_QUALITY)
    return buffer.getvalue()
