"""Pictures of test views: ground truth, render, and their difference, on a sheet or for the HTML report."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from splatting.evaluation.model_folder import counted_picture, load_scores, picture_namer
from utils.system_utils import atomic_write

GAIN = 5  # amplification of the difference
GAP = 6  # pixels between images
HEADER = 26  # height of the titles in pixels
WIDEST = 480  # largest width, in pixels, of an image in a report
_QUALITY = 85


def printable(text: str) -> str:
    """Return the text with the bytes of a file name that are not UTF-8 written as numbers, `\\udcff`."""
    return text.encode("utf-8", "backslashreplace").decode()


def error_image(truth: Image.Image, render: Image.Image) -> Image.Image:
    """Return the absolute difference per channel, amplified by GAIN, black where equal."""
    difference = np.abs(np.asarray(truth.convert("RGB"), np.int16) - np.asarray(render.convert("RGB"), np.int16))
    return Image.fromarray(np.minimum(difference * GAIN, 255).astype(np.uint8))


def contact_sheet(views: Sequence[tuple[str, Image.Image, Image.Image]], widest: int | None = None) -> Image.Image:
    """Draw a row for each view (label, ground truth, render), under a row of titles. Images may differ in size.

    widest: shrink wider images to this width in pixels, after computing the error.
    """
    cells = [
        (label, [_shrunk(image, widest) for image in (truth, render, error_image(truth, render))])
        for label, truth, render in views
    ]
    cell_width = max(images[0].width for _, images in cells)
    cell_height = max(images[0].height for _, images in cells)
    size = (3 * (cell_width + GAP) + GAP, HEADER + len(views) * (cell_height + GAP))
    sheet = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(size=15)
    for column, title in enumerate(("ground truth", "render", f"error x {GAIN}")):
        draw.text((GAP + column * (cell_width + GAP), 4), title, fill="black", font=font)
    for row, (label, images) in enumerate(cells):
        y = HEADER + row * (cell_height + GAP)
        for column, picture in enumerate(images):
            sheet.paste(picture, (GAP + column * (cell_width + GAP), y))
        draw.text((GAP + 6, y + 4), printable(label), fill="white", font=font, stroke_width=2, stroke_fill="black")
    return sheet


def _shrunk(image: Image.Image, widest: int | None) -> Image.Image:
    """Return the image, RGB, at no more than a width in pixels, None: as it is."""
    image = image.convert("RGB")
    if widest is None or image.width <= widest:
        return image
    return image.resize((widest, max(round(image.height * widest / image.width), 1)))


def draw_worst_views(path: Path, run: dict[str, Any], output: Path) -> bool:
    """Draw a run's worst test views on a sheet; return False if it has none.

    Pixels that do not count are white in the images and black in the error.
    """
    if not run["worst_views"]:
        return False
    rows = [(f"{view['picture']}: {view['PSNR']:.2f} dB", *_pair(run, output, view["file"]))
            for view in run["worst_views"]]  # fmt: skip
    with atomic_write(path) as temporary:
        contact_sheet(rows, WIDEST).save(temporary)
    return True


def comparisons(run: dict[str, Any], output: Path, most: int) -> list[dict[str, Any]]:
    """Return at most `most` scored test views of a run's last scored iteration, evenly spread, as blocks of the report.

    Pixels are as in `draw_worst_views`. UserError for a damaged picture.
    """
    model = output / run["model"]
    scores = load_scores(model, f"ours_{run['final_iteration']}")[1]["PSNR"]
    names = sorted(name for name, value in scores.items() if value is not None)
    picture_name = picture_namer(model)
    views = []
    for index in np.unique(np.linspace(0, len(names) - 1, most if names else 0).round().astype(int)):
        photo, render = _pair(run, output, names[index])
        text = (
            f"{picture_name(names[index])}: {scores[names[index]]:.2f} dB; photo and render, and their error x {GAIN}"
        )
        views.append(
            {"photo": _jpeg(photo), "render": _jpeg(render), "error": _jpeg(error_image(photo, render)), "text": text}
        )
    return views


def _pair(run: dict[str, Any], output: Path, name: str) -> list[Image.Image]:
    folder = output / run["model"] / "test" / f"ours_{run['final_iteration']}"
    return [counted_picture(folder, side, name) for side in ("gt", "renders")]


def _jpeg(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    _shrunk(image, WIDEST).save(buffer, "JPEG", quality=_QUALITY)
    return buffer.getvalue()
