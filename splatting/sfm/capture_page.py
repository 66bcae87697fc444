"""The last stage of a conversion: what the capture is worth, and its page, capture.html.

The page has the lines of the report, a picture of cameras and points from above, and a row for each photo.
"""

import base64
import html
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from splatting.files.json_files import read_json, write_json
from splatting.sfm.capture import FEW, Look, findings, lines_of, looks_of, neighbours_of
from splatting.sfm.layout import Layout, image_names
from splatting.sfm.report import summary
from splatting.sfm.stages import Stage
from utils.system_utils import atomic_write

_SIDE, _MARGIN, _ARROW = 900, 60, 24  # pixels of the picture
_STYLE = "body{font:15px sans-serif;max-width:60em;margin:2em auto}td,th{padding:2px 12px;text-align:left}"


def capture_stage(layout: Layout, names: Sequence[str]) -> Stage:
    """Make the stage that looks at the finished scene, adds what it is worth to the report, and writes the page."""

    def work() -> None:
        survey, root = read_json(layout.capture), layout.prepared if layout.prepared.is_dir() else layout.input
        looks = looks_of(root, image_names(root))
        report = read_json(layout.report)
        report |= findings(report, survey["photos"], looks)
        write_json(layout.report, report)
        write_page(layout.page, report, survey, looks, sorted({*looks, *survey["photos"]}))

    return Stage("capture", list(names), lambda: None, work)


def write_page(
    path: Path, report: Mapping[str, Any], survey: Mapping[str, Any], looks: Mapping[str, Look], names: Sequence[str]
) -> None:
    """Write the page. survey: the content of capture.json. names: of all photos, in order."""
    photos, neighbours = survey["photos"], neighbours_of(survey["photos"])
    rows = []
    for name in names:
        if name in photos:
            place = f"{photos[name]['points']} points, {len(neighbours[name])} neighbours"
        else:
            place = f"not placed, matches {report['left_out'].get(name, {}).get('partners', 0)} photos"
        look = looks.get(name)
        cells = [name, place, *((f"{look.sharpness:.0f}", f"{look.brightness:+.2f}") if look else ("", ""))]
        rows.append("".join(f"<td>{html.escape(cell)}</td>" for cell in cells))
    head = "".join(f"<th>{title}</th>" for title in ("photo", "place", "sharpness", "brightness (stops)"))
    said = summary(report), *lines_of(report), *report["advice"]
    listed = "".join(f"<li>{html.escape(line)}</li>" for line in said)
    picture = base64.b64encode(_from_above(survey)).decode()
    text = (
        f"<!doctype html><meta charset=utf-8><title>Capture</title><style>{_STYLE}</style><h1>Capture</h1>"
        f"<ul>{listed}</ul><h2>From above</h2><img width='100%' alt='cameras and points from above' "
        f"src='data:image/png;base64,{picture}'><h2>Photos</h2><table><tr>{head}</tr>"
        + "".join(f"<tr>{row}</tr>" for row in rows)
        + "</table>\n"
    )
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def from_above(directions: np.ndarray) -> np.ndarray:
    """Axes (2, 3) of the picture: across the mean of the cameras' up directions (N, 3)."""
    up = directions.mean(0)
    up /= max(float(np.linalg.norm(up)), 1e-9)
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    first /= max(float(np.linalg.norm(first)), 1e-9)
    return np.stack([first, np.cross(up, first)])


def _from_above(survey: Mapping[str, Any]) -> bytes:
    """A PNG: points in their colours, and each camera as an arrow along its view, the weakly connected ones red."""
    photos = survey["photos"]
    places, views, ups = (np.array([photo[key] for photo in photos.values()]) for key in ("place", "view", "up"))
    axes = from_above(ups)
    points, colors = np.array(survey["points"]).reshape(-1, 3), np.array(survey["colors"], np.uint8).reshape(-1, 3)
    weak = [len(others) < FEW for others in neighbours_of(photos).values()]
    flat, seen, along = places @ axes.T, points @ axes.T, views @ axes.T
    # Without the farthest points, which would leave the cameras a spot.
    low, high = (np.quantile(np.concatenate([flat, seen]), part, axis=0) for part in (0.02, 0.98))
    low, high = np.minimum(low, flat.min(0)), np.maximum(high, flat.max(0))
    scale = (_SIDE - 2 * _MARGIN) / max(float((high - low).max()), 1e-9)

    def pixels(flat: np.ndarray) -> np.ndarray:
        return _SIDE / 2 + (flat - (low + high) / 2) * [scale, -scale]

    canvas = np.full((_SIDE, _SIDE, 3), 255, np.uint8)
    x, y = pixels(seen).astype(int).T
    inside = (x >= 0) & (x < _SIDE - 1) & (y >= 0) & (y < _SIDE - 1)
    for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
        canvas[y[inside] + down, x[inside] + right] = colors[inside]
    picture = Image.fromarray(canvas)
    draw = ImageDraw.Draw(picture)
    for start, way, is_weak in zip(pixels(flat), along * [1, -1], weak, strict=True):
        color, across = "red" if is_weak else "blue", np.array([-way[1], way[0]])
        end = start + _ARROW * way
        draw.line([tuple(start), tuple(end)], fill=color, width=2)
        head = (end, end - 0.4 * _ARROW * way + 0.2 * _ARROW * across, end - 0.4 * _ARROW * way - 0.2 * _ARROW * across)
        draw.polygon([tuple(corner) for corner in head], fill=color)
    buffer = io.BytesIO()
    picture.save(buffer, "PNG")
    return buffer.getvalue()
