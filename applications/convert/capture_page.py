"""The last stage of a conversion: judges the quality of the capture, and writes its page, capture.html.

This module computes the contents of the page; its texts are in capture.html.jinja.
"""

import base64
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from PIL import Image, ImageOps

from applications.convert.checks import (
    LONELY,
    Look,
    describe_capture,
    find_neighbours,
    is_wrong,
    rate_capture,
    training_options,
    why_unusable,
)
from applications.convert.layout import Layout, image_names
from applications.convert.mapping import way_name
from applications.convert.photo_quality import compare_brightness, measure_looks
from applications.convert.report import summarise
from applications.convert.stages import Stage
from groundwork.files.color_profiles import to_srgb
from groundwork.files.image_files import UNREADABLE, open_image
from groundwork.files.json_files import read_json, write_json
from groundwork.host.progress import in_threads
from scene.readers.info import from_above
from utils.system_utils import atomic_write

_SIDE, _MARGIN = 900, 50  # pixels of the picture from above
_THUMBNAIL = 120  # pixels of the longer side
_MOST = 300  # thumbnails, of about 4 kB each
_Data = Mapping[str, Any]  # of a JSON file


def capture_stage(layout: Layout, names: Sequence[str], seconds: Callable[[], dict[str, float]]) -> Stage:
    """Make the stage that rates the finished scene, adds the rating to the report, and writes the page.

    seconds: returns those of the stages before.
    """

    def rate_scene() -> None:
        """Add the rating of the capture to convert_report.json, and write capture.html."""
        survey, root = read_json(layout.capture), layout.prepared if layout.prepared.is_dir() else layout.input
        looks = compare_brightness(measure_looks(root, image_names(root)), layout)
        report = read_json(layout.report)
        report |= {"seconds": seconds()} | rate_capture(report, survey["photos"], looks)
        write_json(layout.report, report)
        write_page(layout.page, report, survey, looks, sorted({*looks, *survey["photos"]}), root)

    return Stage("capture", list(names), lambda: None, rate_scene, makes=[layout.page])


def write_page(
    path: Path, report: _Data, survey: _Data, looks: Mapping[str, Look], names: Sequence[str], root: Path
) -> None:
    """Write the page.

    survey: the content of capture.json.
    names: of all photos, in order.
    root: the folder of the photos.
    """
    photos = _list_photos(report, survey["photos"], looks, names)
    pictured = [photo for photo in photos if photo["problems"] or len(photos) <= _MOST][:_MOST]
    files = [root / photo["name"] for photo in pictured]
    thumbnails = in_threads(_make_thumbnail, files, desc="Making thumbnails")
    for photo, thumbnail in zip(pictured, thumbnails, strict=True):
        photo["thumbnail"] = thumbnail
    options = {"autoescape": True, "undefined": jinja2.StrictUndefined, "trim_blocks": True, "lstrip_blocks": True}
    environment = jinja2.Environment(loader=jinja2.FileSystemLoader(Path(__file__).parent), **options)
    text = environment.get_template("capture.html.jinja").render(
        above=_draw_from_above(survey), is_wrong=is_wrong, way_name=way_name, lines=_list_lines(report), photos=photos,
        pictured=len(pictured), report=report, scene=path.absolute().parent.name, unusable=why_unusable(report),
    )  # fmt: skip
    with atomic_write(path) as temporary:
        # Names that are not UTF-8 have surrogates, which appear as numbers.
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def _list_lines(report: _Data) -> list[tuple[str, bool]]:
    """List the lines of the report but those on photos to take, each with True if it tells of a problem."""
    found = {"overlap": report["weakly_connected"], "blur": report["blurred"], "brightness": training_options(report)}
    said = describe_capture(report)[: -len(report["again"]) or None]  # photos to take again come last
    return [
        (summarise(report), bool(report["left_out"])),
        *((line, bool(found.get(line.split(":")[0]))) for line in said),
        *((line, True) for line in report["advice"]),
    ]


def _list_photos(report: _Data, placed: _Data, looks: Mapping[str, Look], names: Sequence[str]) -> list[dict[str, Any]]:
    """Return name, problems and facts (by title) of each photo, photos with problems first; `row` numbers them."""
    neighbours, against = find_neighbours(placed), set((report.get("tried") or [{}])[0].get("against", ()))
    sharpness = np.median([look.sharpness for look in looks.values() if np.isfinite(look.sharpness)] or [1])
    brightness = np.median([look.brightness for look in looks.values() if np.isfinite(look.brightness)] or [0])
    lonely = {name for name in against if report["left_out"].get(name, {}).get("partners", 0) <= LONELY}
    problems = {
        "left out: its matches contradict the others": against - lonely,
        "left out: too few other photos match it": lonely,
        "not placed": set(names) - set(placed) - against,
        "weakly connected": set(report["weakly_connected"]),
        "blurred": set(report["blurred"]),
    }
    photos = []
    for name in names:
        if name in placed:
            facts = {"points": placed[name]["points"], "neighbours": len(neighbours[name])}
        else:
            facts = {"matching photos": report["left_out"].get(name, {}).get("partners", 0)}
        if (look := looks.get(name)) and np.isfinite(look.sharpness):
            facts["sharpness"] = f"{look.sharpness / max(sharpness, 1e-9):.0%}"
        if look and np.isfinite(look.brightness):
            facts["brightness"] = f"{round(look.brightness - brightness, 1) + 0:+.1f}"  # 0 is added as it ends -0.0
        found = [problem for problem, of in problems.items() if name in of]
        photos.append({"name": name, "problems": found, "facts": facts, "thumbnail": None})
    photos.sort(key=lambda photo: not photo["problems"])
    return [photo | {"row": row} for row, photo in enumerate(photos)]


def _make_thumbnail(path: Path) -> str | None:
    """A photo as a small embedded JPEG; None if it is missing or cannot be read."""
    try:
        with open_image(path) as image:
            image.draft("RGB", (2 * _THUMBNAIL, 2 * _THUMBNAIL))  # decodes a large JPEG at a fraction of its size
            small = to_srgb(ImageOps.exif_transpose(image)).convert("RGB")
    except UNREADABLE:
        return None
    small.thumbnail((_THUMBNAIL, _THUMBNAIL))
    return _embed_image(small, "JPEG", quality=70, optimize=True)


def _embed_image(image: Image.Image, kind: str, **options: Any) -> str:
    """Return a picture as a data: URI. kind: Pillow's name of the format; options: of its `save`."""
    buffer = io.BytesIO()
    image.save(buffer, kind, **options)
    return f"data:image/{kind.lower()};base64,{base64.b64encode(buffer.getvalue()).decode()}"


def _draw_from_above(survey: _Data) -> dict[str, Any]:
    """The picture from above: its size, the points as a PNG, and of each camera by name x, y, degrees and length."""
    photos = survey["photos"]
    places, views, ups = (np.array([photo[key] for photo in photos.values()]) for key in ("place", "view", "up"))
    axes = from_above(ups.mean(0)) * [[1], [-1]]  # y of a picture goes down
    points, colors = np.array(survey["points"]).reshape(-1, 3), np.array(survey["colors"], np.uint8).reshape(-1, 3)
    flat, seen, along = places @ axes.T, points @ axes.T, views @ axes.T
    # Without the farthest points, which would leave the cameras a spot.
    low, high = (np.quantile(np.concatenate([flat, seen]), part, axis=0) for part in (0.02, 0.98))
    low, high = np.minimum(low, flat.min(0)), np.maximum(high, flat.max(0))
    scale = (_SIDE - 2 * _MARGIN) / max(float((high - low).max()), 1e-9)
    size = ((high - low) * scale + 2 * _MARGIN).astype(int)
    spots = ((seen - low) * scale + _MARGIN).astype(int) // 2  # half the picture's size, so that a point is 2 pixels
    inside = ((spots >= 0) & (spots < size // 2)).all(1)
    canvas = np.full((*size[::-1] // 2, 3), 255, np.uint8)
    canvas[spots[inside, 1], spots[inside, 0]] = colors[inside]
    cameras = np.c_[(flat - low) * scale + _MARGIN, np.degrees(np.arctan2(*along.T[::-1])), np.hypot(*along.T)]
    named = dict(zip(photos, cameras.tolist(), strict=True))
    return {
        "size": size.tolist(),
        "points": _embed_image(Image.fromarray(canvas), "PNG", optimize=True),
        "cameras": named,
    }
