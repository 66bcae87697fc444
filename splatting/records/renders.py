"""A rendered set of views, `test/ours_N` of a model folder: its images, masks and times, and sheets made of them."""

from __future__ import annotations

import hashlib
import io
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from groundwork.files.image_files import UNREADABLE, open_image
from groundwork.host.listing import as_utf8
from splatting.records.model_folder import json_or_none, load_scores
from utils.system_utils import UserError, atomic_write, saved_ply

GIVEN_POSES = "given_poses"  # behind the name of renders and scores with the dataset's poses, where others were trained
FITTED = "fitted_appearance"  # the same of right halves, with the photos' appearance fitted to left ones
MASK_PICTURE = "robust_masks.png"  # in a model folder: photos of which a training has masked most
BESIDE = (GIVEN_POSES, FITTED)
SCORES = ("PSNR", "SSIM", "LPIPS", "DISTS", "STLPIPS")
if TYPE_CHECKING:
    import torch

ERRORS = "errors"  # folder beside those of the images: error maps of metrics.py
INCOMPLETE = "incomplete"  # beside them, until the last image of a set is written
DEPTHS = "depth_errors.json"  # beside them: of each view, the errors of depth at held-out points
TIMES = "render_times.json"  # beside the folders of images: the time of each view
GAIN = 5  # amplification of the difference
GAP = 6  # pixels between images of a sheet
HEADER = 26  # height of a sheet's titles in pixels
INSET, STROKE = 6, 2  # pixels: a label's distance from the left side of its image, and the line around its letters
WORST = 3  # views of a sheet
WIDEST = 480  # largest width, in pixels, of an image in a report
_QUALITY = 85


def summarise_times(
    seconds: Sequence[float], sizes: Sequence[tuple[int, int]], gaussians: int, antialiasing: bool, device: torch.device
) -> dict[str, Any]:
    """Return the content of TIMES.

    seconds, sizes: seconds and (width, height) in pixels of the views, in the order of their PNGs. The result has each
        size once.
    gaussians: number of Gaussians.
    device: device that rendered. The result's `fps` are frames per second at the median, and its `threads` those of the
        CPU, whatever the device.
    """
    import torch

    from groundwork.host.machine import device_name

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


def model_digest(model: Path, iteration: str) -> str | None:
    """Return the SHA-256 of the PLY of an iteration, None if a model folder has none of it.

    iteration: with what the folder's name says besides, as in 30000_given_poses.
    """
    number = iteration.partition("_")[0]
    ply = saved_ply(model, number)
    if not number.isdecimal() or not ply.is_file():
        return None
    digest = hashlib.sha256()
    with open(ply, "rb") as file:
        for part in iter(lambda: file.read(1 << 20), b""):
            digest.update(part)
    return digest.hexdigest()


def image_of(file: Path) -> Image.Image:
    """Read a render or a ground truth, RGB."""
    return _read_image(file, lambda image: image.convert("RGB"))


def image_size(file: Path) -> tuple[int, int]:
    """Read width and height in pixels from the file's header."""
    return _read_image(file, lambda image: image.size)


def _read_image(file: Path, read: Callable[[Image.Image], Any]) -> Any:
    """Open an image file, and return what a function reads of it. UserError for a missing or damaged file."""
    try:
        with open_image(file) as image:
            return read(image)
    except UNREADABLE as error:
        raise UserError(f"{file} is missing or damaged ({error}); run render.py again") from error


def view_names(folder: Path) -> list[str]:
    """List the names of a folder's PNGs, sorted; none if there is no folder."""
    return sorted(file.name for file in folder.glob("*.png") if not file.name.startswith("."))


def mask_of(method: Path, name: str) -> np.ndarray | None:
    """Read which pixels of a view count, (H, W) bool; None: all. method: the folder `ours_N`."""
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
        if (mask := mask_of(method, name)) is not None:
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


def error_map(method: Path, name: str) -> Path:
    """Return the path of a view's error map.

    method: the folder `ours_N`.
    """
    return method / ERRORS / f"{Path(name).stem}.jpg"


def write_error_map(method: Path, name: str, truth: np.ndarray, render: np.ndarray, mask: np.ndarray | None) -> None:
    """Write the `error_image` of images (H, W, 3) uint8, black where a mask (H, W) bool counts no pixel."""
    if mask is not None:
        render = np.where(mask[..., None], render, truth)
    with atomic_write(error_map(method, name)) as temporary:
        error_image(*map(Image.fromarray, (truth, render))).save(temporary, "JPEG", quality=_QUALITY)


def worst_views(model: Path, psnrs: Mapping[str, float | None]) -> list[dict[str, Any]]:
    """List the views of the lowest PSNR, worst first: PSNR, `file`, and `picture`, the name of the photo."""
    worst = sorted((value, name) for name, value in psnrs.items() if value is not None)[:WORST]
    picture_name = photo_namer(model)
    return [{"PSNR": value, "file": name, "picture": picture_name(name)} for value, name in worst]


def contact_sheet(views: Sequence[tuple[str, Image.Image, Image.Image]]) -> Image.Image:
    """Draw a row for each view (label, ground truth, render), with the error."""
    rows = [[(label, truth), ("", render), ("", error_image(truth, render))] for label, truth, render in views]
    return sheet(("ground truth", "render", f"error x {GAIN}"), rows)


def sheet(
    titles: Sequence[str], rows: Sequence[Sequence[tuple[str, Image.Image]]], widest: int | None = None
) -> Image.Image:
    """Draw rows of labelled images, which may differ in size, under a row of titles that fit.

    widest: shrink wider images to this width in pixels.
    """
    from PIL import ImageDraw, ImageFont  # trainings, which import this module, draw nothing

    font = ImageFont.load_default(size=15)
    titles = [as_utf8(title) for title in titles]
    cells = [[(as_utf8(label), _shrink(image, widest)) for label, image in row] for row in rows]
    cell_height = max(image.height for row in cells for _, image in row)
    lefts = [GAP]  # of the columns, and where one more would begin
    for title, *column in zip(titles, *cells, strict=True):
        needed = [width for label, image in column for width in (image.width, _label_width(font, label))]
        lefts.append(lefts[-1] + max(math.ceil(font.getlength(title)), *needed) + GAP)
    drawn = Image.new("RGB", (lefts[-1], HEADER + len(cells) * (cell_height + GAP)), "white")
    draw = ImageDraw.Draw(drawn)
    for x, title in zip(lefts, titles, strict=False):
        draw.text((x, 4), title, fill="black", font=font)
    for place, row in enumerate(cells):
        y = HEADER + place * (cell_height + GAP)
        for x, (label, image) in zip(lefts, row, strict=False):
            drawn.paste(image, (x, y))
            draw.text((x + INSET, y + 4), label, fill="white", font=font, stroke_width=STROKE, stroke_fill="black")
    return drawn


def _label_width(font: Any, label: str) -> int:
    """Return the pixels from the left side of an image to the end of its label."""
    return math.ceil(INSET + font.getlength(label) + STROKE) if label else 0


def _shrink(image: Image.Image, widest: int | None) -> Image.Image:
    """Return the image, RGB, at no more than a width in pixels, None: as it is."""
    image = image.convert("RGB")
    if widest is None or image.width <= widest:
        return image
    return image.resize((widest, max(round(image.height * widest / image.width), 1)))


class ComparedViews:
    """The test views that several runs scored, those of the lowest PSNR first: photos, renders and their errors.

    Pixels that do not count are white in the images and black in the error. UserError for damaged scores or images.

    runs: finished runs of one scene with the same ground truth, one of each option set.
    """

    def __init__(self, runs: Sequence[dict[str, Any]], output: Path) -> None:
        """Read the scores of the runs, and order the views by their mean PSNR.

        output: folder below which the model folders of the runs are.
        """
        self.names = [run["config"] or "render" for run in runs]
        self._runs, self._output = runs, output
        self._per_view = [load_scores(output / run["model"], f"ours_{run['final_iteration']}")[1] for run in runs]
        self._scores = [of_run["PSNR"] for of_run in self._per_view]
        scored = [name for name in self._scores[0] if None not in [scores.get(name) for scores in self._scores]]
        self.files = sorted(scored, key=lambda name: (statistics.fmean(own[name] for own in self._scores), name))
        self._photo_name = photo_namer(output / runs[0]["model"])

    def _read_images(self, file: str) -> tuple[Image.Image, list[Image.Image]]:
        pairs = [_read_pair(run, self._output, file) for run in self._runs]
        return pairs[0][0], [render for _, render in pairs]

    def table(self) -> dict[str, Any]:
        """Return the scores of all views: `heads`, and `rows` of (text, path of an error map or None) by column.

        The columns are the PSNR of each option set, or all scores of a single one.
        """
        columns = [(run, scores, "PSNR") for run, scores in zip(self._runs, self._per_view, strict=True)]
        if len(columns) == 1:
            (run, scores, _), *_ = columns
            known = [key for key in SCORES if all(scores.get(key, {}).get(file) is not None for file in self.files)]
            columns = [(run, scores, key) for key in known]
        heads = [key if len(self._runs) == 1 else run["config"] for run, _, key in columns]
        return {"heads": ["test view", *heads], "rows": [self._make_row(file, columns) for file in self.files]}

    def _make_row(self, file: str, columns: Sequence[tuple[dict, dict, str]]) -> list[tuple[str, Path | None]]:
        """Return a view's cells of the table: its name, then each score with the path of an error map, or None.

        columns: run, scores of the run, and name of the score, of each column.
        """
        cells: list[tuple[str, Path | None]] = [(self._photo_name(file), None)]
        for run, scores, key in columns:
            path, is_psnr = error_map(_method_folder(run, self._output), file), key == "PSNR"
            cells.append((f"{scores[key][file]:.{2 if is_psnr else 4}f}", path if is_psnr and path.is_file() else None))
        return cells

    def shown(self, most: int) -> list[dict[str, Any]]:
        """Return at most `most` views: the worst, and others evenly spread to the best.

        Each has the `name` of its photo, `photo` as a JPEG, and `sets`: `text`, `render` and `error` of each run.
        """
        places = np.unique(np.linspace(0, len(self.files) - 1, min(most, len(self.files))).round().astype(int))
        return [self._describe_view(self.files[place]) for place in places]

    def _describe_view(self, file: str) -> dict[str, Any]:
        """Return a view's name, its photo as a JPEG, and text, render and error of each run."""
        photo, renders = self._read_images(file)
        texts = [f"{name}: {own[file]:.2f} dB" for name, own in zip(self.names, self._scores, strict=True)]
        sets = [{"text": text, "render": _to_jpeg(render), "error": _to_jpeg(error_image(photo, render))}
                for text, render in zip(texts, renders, strict=True)]  # fmt: skip
        return {"name": self._photo_name(file), "photo": _to_jpeg(photo), "sets": sets}

    def draw_worst(self, path: Path) -> None:
        """Draw the worst views on a sheet; those of a single run with their errors. UserError if there is no view."""
        if not self.files:
            raise UserError("no view has a PSNR of each option set")
        rows = []
        for file in self.files[:WORST]:
            photo, renders = self._read_images(file)
            labels = [f"{own[file]:.2f} dB" for own in self._scores]
            rows.append([(self._photo_name(file), photo), *zip(labels, renders, strict=True)])
            if len(renders) == 1:
                rows[-1].append(("", error_image(photo, renders[0])))
        titles = ("photo", *self.names, f"error x {GAIN}")[: len(rows[0])]
        with atomic_write(path) as temporary:
            sheet(titles, rows, WIDEST).save(temporary)


def _method_folder(run: dict[str, Any], output: Path) -> Path:
    return output / run["model"] / "test" / f"ours_{run['final_iteration']}"


def _read_pair(run: dict[str, Any], output: Path, name: str) -> list[Image.Image]:
    """Read ground truth and render of a view, RGB, white where pixels do not count."""
    method = _method_folder(run, output)
    pair, mask = [image_of(method / side / name) for side in ("gt", "renders")], mask_of(method, name)
    if mask is None:
        return pair
    return [Image.fromarray(np.where(mask[..., None], np.asarray(image), np.uint8(255))) for image in pair]


def _to_jpeg(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    _shrink(image, WIDEST).save(buffer, "JPEG", quality=_QUALITY)
    return buffer.getvalue()
