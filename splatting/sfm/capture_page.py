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

from splatting.files.json_files import read_json, write_json
from splatting.sfm.capture import Look, findings, lines_of, looks_of, neighbours_of
from splatting.sfm.colmap import worker_command
from splatting.sfm.layout import Layout, image_names
from splatting.sfm.programs import run_programs
from splatting.sfm.report import summary
from splatting.sfm.stages import Stage
from utils.system_utils import atomic_write

_STYLE = "body{font:15px sans-serif;max-width:60em;margin:2em auto}td,th{padding:2px 12px;text-align:left}"


def capture_stage(layout: Layout, names: Sequence[str]) -> Stage:
    """Make the stage that looks at the finished scene, adds what it is worth to the report, and writes the page."""

    def work() -> None:
        out = layout.work / "capture.json"
        command = worker_command(layout, "capture", model=str(layout.sparse / "0"), out=str(out))
        run_programs(layout.log, [command], "Reading the scene", 1, out.exists)
        survey, root = read_json(out), layout.prepared if layout.prepared.is_dir() else layout.input
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
    from matplotlib.figure import Figure

    photos = survey["photos"]
    places, views, ups = (np.array([photo[key] for photo in photos.values()]) for key in ("place", "view", "up"))
    axes = from_above(ups)
    points, colors = np.array(survey["points"]).reshape(-1, 3), np.array(survey["colors"]).reshape(-1, 3)
    figure = Figure(figsize=(9, 7), layout="constrained")
    plot = figure.subplots()
    weak = np.array([len(others) < 2 for others in neighbours_of(photos).values()])
    flat, seen = places @ axes.T, points @ axes.T
    plot.scatter(*seen.T, s=2, c=colors / 255, linewidths=0)
    plot.quiver(*flat.T, *(views @ axes.T).T, color=np.where(weak, "tab:red", "tab:blue"), width=0.003)
    # Far points would leave the cameras a spot.
    low, high = (np.quantile(np.concatenate([flat, seen]), q, axis=0) for q in (0.02, 0.98))
    low, high = np.minimum(low, flat.min(0)), np.maximum(high, flat.max(0))
    margin = 0.05 * (high - low).max() + 1e-9
    plot.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin), aspect="equal")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120, metadata={"Software": None})
    return buffer.getvalue()
