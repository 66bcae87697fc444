"""A rendered set of views, `test/ours_N` of a model folder: its images, masks and times, and sheets made of them."""

from __future__ import annotations

import hashlib
import io
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from splatting.evaluation.figures import printable
from splatting.evaluation.model_folder import json_or_none, load_scores
from splatting.files.image_files import UNREADABLE, open_render
from utils.system_utils import UserError, atomic_write

if TYPE_CHECKING:
    import torch

TIMES = "render_times.json"  # beside the folders of images: the time of each view
GAIN = 5  # amplification of the difference
GAP = 6  # pixels between images of a sheet
HEADER = 26  # height of a sheet's titles in pixels
WIDEST = 480  # largest width, in pixels, of an image in a report
_QUALITY = 85


def summarise_times(
    seconds: Sequence[float], sizes: Sequence[tuple[int, int]], gaussians: int, antialiasing: bool, device: torch.device
) -> dict[str, Any]:
    """The content of TIMES, from `seconds` and `sizes` (width, height; pixels) of the views in the order of their PNGs.

    fps: frames per second at the median. sizes: each size once. threads: those of the CPU, whatever the device.
    """
    import torch

    from splatting.host.machine import device_name

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


def image_of(file: Path) -> Image.Image:
    """Read a render or a ground truth, RGB."""
    return _opened(file, lambda image: image.convert("RGB"))


def image_size(file: Path) -> tuple[int, int]:
    """Read width and height in pixels from the file's header."""
    return _opened(file, lambda image: image.size)


def _opened(file: Path, read: Callable[[Image.Image], Any]) -> Any:
    try:
        with open_render(file) as image:
            return read(image)
    except UNREADABLE as error:
        raise UserError(f"{file} is missing or damaged; run render.py and metrics.py again") from error


def view_names(folder: Path) -> list[str]:
    """List the names of a folder's PNGs, sorted; none if there is no folder."""
    return sorted(file.name for file in folder.glob("*.png") if not file.name.startswith("."))


def _mask(method: Path, name: str) -> np.ndarray | None:
    """Read which pixels of a view count for metrics.py, (H, W) bool; None: all. method: the folder `ours_N`."""
    file = method / "masks" / name
    return np.asarray(image_of(file))[..., 0] > 0 if file.is_file() else None


def ground_truth_digest(method: Path) -> str:
    """Return the SHA-256 of the ground truth in a folder `ours_N`, in order: sizes, pixels, masks.

    Scores can be compared only if it is the same. It changes with split, resolution, resize filter, background, masks.
    """
    digest = hashlib.sha256()
    for name in view_names(method / "gt"):
        image = image_of(method / "gt" / name)
        digest.update(f"{image.width}x{image.height}".encode())
        digest.update(np.asarray(image).tobytes())
        if (mask := _mask(method, name)) is not None:
            digest.update(b"mask")
            digest.update(mask.tobytes())
    return digest.hexdigest()


def photo_namer(model: Path) -> Callable[[str], str]:
    """Return a function that names the photo of a rendered test view, by cameras.json, which has test views first."""
    cameras = json_or_none(model / "cameras.json")

    def name(file: str) -> str:
        try:
            return str(cameras[int(Path(file).stem)]["img_name"])
        except (ValueError, IndexError, KeyError, TypeError):
            return file

    return name


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
        for column, image in enumerate(images):
            sheet.paste(image, (GAP + column * (cell_width + GAP), y))
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
    """Return at most `most` scored test views of a run's last scored iteration, evenly spread.

    Each has its `photo`, `render` and `error` as JPEGs, and a `text`. Pixels are as in `draw_worst_views`. UserError
    for a damaged image.
    """
    model = output / run["model"]
    scores = load_scores(model, f"ours_{run['final_iteration']}")[1]["PSNR"]
    names = sorted(name for name, value in scores.items() if value is not None)
    photo_name = photo_namer(model)
    views = []
    for index in np.unique(np.linspace(0, len(names) - 1, most if names else 0).round().astype(int)):
        name = names[index]
        photo, render = _pair(run, output, name)
        text = f"{photo_name(name)}: {scores[name]:.2f} dB; photo and render, and their error x {GAIN}"
        images = {"photo": photo, "render": render, "error": error_image(photo, render)}
        views.append({**{side: _jpeg(image) for side, image in images.items()}, "text": text})
    return views


def _pair(run: dict[str, Any], output: Path, name: str) -> list[Image.Image]:
    """Read ground truth and render of a view, RGB, white where pixels do not count."""
    method = output / run["model"] / "test" / f"ours_{run['final_iteration']}"
    pair, mask = [image_of(method / side / name) for side in ("gt", "renders")], _mask(method, name)
    if mask is None:
        return pair
    return [Image.fromarray(np.where(mask[..., None], np.asarray(image), np.uint8(255))) for image in pair]


def _jpeg(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    _shrunk(image, WIDEST).save(buffer, "JPEG", quality=_QUALITY)
    return buffer.getvalue()
