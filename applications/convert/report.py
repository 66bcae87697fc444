"""Report of a conversion: its models, the photos that were placed, its lenses.

Its entry `unusable` is the verdict: why the scene should not be trained, or null (checks.py, `why_unusable`). The
survey
is what the models of the mapper contain, as a file of worker.py (its step survey), which `read_survey` reads.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any, NamedTuple

from applications.convert.checks import why_unusable
from applications.convert.layout import Layout
from groundwork.files.json_files import read_json, write_json
from utils.system_utils import UserError


class Model(NamedTuple):
    """One model of the mapper. registered: names of photos; track_length: mean views per point; error: mean, pixels.

    cameras: id, model, size, params, and photos, by name the result of worker.py's `_probe_focal_length`.
    """

    folder: str
    registered: list[str]
    points: int
    track_length: float
    error: float
    cameras: list[dict[str, Any]]


def read_tried(layout: Layout) -> list[dict[str, Any]]:
    """Read mapping.py's judgement of each way, the chosen one first; an empty list where it did not judge."""
    return read_json(layout.judged) if layout.judged.is_file() else []


def read_survey(layout: Layout, tried: Sequence[Mapping[str, Any]]) -> list[Model]:
    """Read the models that worker.py's survey found: the one that was chosen (`read_tried`), then the largest first.

    UserError for a photo's name that leads out of the folder of photos.
    """
    chosen = tried[0].get("folder") if tried else None
    models = [Model(**entry) for entry in read_json(layout.survey)]
    for name in (name for model in models for name in model.registered):
        if PurePath(name).is_absolute() or ".." in PurePath(name).parts:
            raise UserError(f"the model in {layout.models} names a photo {name}, outside of the folder of its photos")
    return sorted(
        models, key=lambda model: (model.folder != chosen, -len(model.registered), -model.points, model.folder)
    )


def summarise(report: dict[str, Any]) -> str:
    """Summarise the contents of convert_report.json in one line."""
    return (
        f"{report['registered']} of {report['photos']} photos placed; {report['points']} points, each in "
        f"{report['mean_track_length']:.1f} photos, mean error {report['mean_error_px']:.2f} pixels"
        + (f"; {more} more points at these poses" if (more := report.get("more_points")) else "")
    )


def describe_lenses(report: dict[str, Any]) -> str:
    """Say in one line which photos convert_report.json is about: those of the lenses, or undistorted ones."""
    if report["lenses"] == "undistort":
        return "the scene has undistorted photos, with pinhole cameras"
    models = ", ".join(sorted({camera["model"] for camera in report["cameras"]}))
    return f"the scene has the photos as they are, with the cameras that were fitted ({models})"


def write_report(
    path: Path, models: Sequence[Model], images: Sequence[str], partners: dict[str, int], **made: Any
) -> None:
    """Write convert_report.json: photos placed and left out, models, the verdict `unusable`, and `made`.

    models: the chosen one first.
    images: names of all photos.
    partners: number of matching photos of each photo.
    made: further entries: settings, advice, ...
    """
    chosen = models[0]
    content = {
        **made,
        "left_out": {name: {"partners": partners.get(name, 0)} for name in set(images) - set(chosen.registered)},
        "mean_error_px": round(chosen.error, 4),
        "mean_track_length": round(chosen.track_length, 4),
        "model": chosen.folder,
        "models": [{"folder": m.folder, "photos": len(m.registered), "points": m.points} for m in models],
        "photos": len(images),
        "points": chosen.points,
        "registered": len(chosen.registered),
    }
    write_json(path, {**content, "unusable": why_unusable(content)})


def record_inputs(path: Path, **inputs: Any) -> dict[str, Any]:
    """Return the contents of convert_report.json with entries about `input`, which may change without a new model."""
    content = read_json(path)
    if content != (whole := {**content, **inputs}):
        write_json(path, whole)
    return whole
