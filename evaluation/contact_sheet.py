"""A contact sheet of test views: ground truth, render, and their difference."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from evaluation.printable import printable

GAIN = 5  # amplification of the difference
GAP = 6  # pixels between images
HEADER = 26  # height of the titles in pixels


def error_image(truth: Image.Image, render: Image.Image) -> Image.Image:
    """Return the absolute difference per channel, amplified by GAIN, black where equal."""
    difference = np.abs(np.asarray(truth.convert("RGB"), np.int16) - np.asarray(render.convert("RGB"), np.int16))
    return Image.fromarray(np.minimum(difference * GAIN, 255).astype(np.uint8))


def contact_sheet(views: Sequence[tuple[str, Image.Image, Image.Image]], widest: int | None = None) -> Image.Image:
    """Draw a row for each view (label, ground truth, render), under a row of titles. Images may differ in size.

    widest: shrink wider images to this width in pixels, after computing the error.
    """
    cells = [
        (label, [shrunk(image, widest) for image in (truth, render, error_image(truth, render))])
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
            sheet.paste(picture.convert("RGB"), (GAP + column * (cell_width + GAP), y))
        draw.text((GAP + 6, y + 4), printable(label), fill="white", font=font, stroke_width=2, stroke_fill="black")
    return sheet


def shrunk(image: Image.Image, widest: int | None) -> Image.Image:
    """Return the image at no more than a width in pixels, None: as it is."""
    if widest is None or image.width <= widest:
        return image
    return image.convert("RGB").resize((widest, max(round(image.height * widest / image.width), 1)))
