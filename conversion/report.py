"""What was registered, and what to do when that is too little."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from utils.files.json_files import read_json, write_json
from utils.files.listing import some
from utils.system_utils import UserError

FEWEST_POINTS = 1000  # fewer make a poor start: density control has to find the scene by itself
SHORT_TRACKS = 3.0  # views a point; below, most points hang on a single pair
LARGE_ERROR = 1.5  # pixels; a good model of sharp photos has 0.3 to 1


class Model(NamedTuple):
    """One model of the mapper. registered: names; track_length: mean views a point; error: mean, in pixels."""

    folder: str
    registered: list[str]
    points: int
    track_length: float
    error: float
    cameras: list[dict[str, Any]]


def read_survey(path: Path) -> list[Model]:
    """The models that worker.py's survey found, the largest (photos, then points) first."""
    models = [Model(**entry) for entry in read_json(path)]
    return sorted(models, key=lambda model: (-len(model.registered), -model.points, model.folder))


def refuse_nothing(models: Sequence[Model], photos: Sequence[str], partners: dict[str, int], matcher: str) -> None:
    """UserError with the likeliest reason when no model has a registered photo."""
    if models and models[0].registered:
        return
    matched = sum(count > 0 for count in partners.values())
    if matched < 2:
        reason = "no two of them show the same things sharply enough"
    else:
        reason = f"{matched} of them match another, but no pair has enough parallax or matches to start from"
    remedy = "take photos that overlap by 60 to 80 % from places some steps apart, sharp and evenly lit"
    if matcher == "sequential":
        remedy += ", or use --matcher exhaustive"
    raise UserError(f"none of {len(photos)} photos could be placed: {reason}; {remedy}")


def advice(
    models: Sequence[Model], photos: Sequence[str], partners: dict[str, int], matcher: str, at_limit: int = 0
) -> list[str]:
    """One line for each thing about the chosen model, models[0], that will show in training; empty: all is well.

    at_limit: number of features where photos had more than --max_num_features allows, else 0.
    """
    chosen = models[0]
    out = sorted(set(photos) - set(chosen.registered))
    lines = []
    if out:
        lonely = sum(partners.get(name, 0) == 0 for name in out)
        text = f"{len(out)} of {len(photos)} photos were left out ({some(out)})"
        if lonely:
            text += f", {lonely} of them match no other photo"
        remedy = "take more photos between them and their neighbours, or remove them if they are blurred"
        if matcher == "sequential":
            remedy += "; --matcher exhaustive compares every pair"
        lines.append(f"{text}; {remedy}")
    others = [len(model.registered) for model in models[1:] if set(model.registered) - set(chosen.registered)]
    if others:
        sizes = ", ".join(map(str, others))
        lines.append(
            f"the photos fall into {len(others) + 1} parts that don't connect ({len(chosen.registered)} photos are "
            f"used, the others have {sizes}); take photos that lead from one part to the other, or try --mapper global"
        )
    if chosen.points < FEWEST_POINTS:
        text = f"only {chosen.points} points, {FEWEST_POINTS} or more make a good start; larger or more photos help"
        lines.append(text + (f", and --max_num_features {2 * at_limit}" if at_limit else ""))
    if chosen.track_length < SHORT_TRACKS:
        lines.append(
            f"a point is seen by {chosen.track_length:.1f} photos on average, which means little overlap; take more "
            "photos, with 60 to 80 % of each in the next"
        )
    if chosen.error > LARGE_ERROR:
        lines.append(
            f"points miss their pixels by {chosen.error:.1f} pixels on average; if things moved, mask them "
            "(--mask_path); if photos of several lenses are mixed, convert them apart; a fisheye lens needs --camera "
            "OPENCV_FISHEYE"
        )
    return lines


def summary(report: dict[str, Any]) -> str:
    """One line from the contents of convert_report.json."""
    return (
        f"{report['registered']} of {report['photos']} photos placed, {report['points']} points, each in "
        f"{report['mean_track_length']:.1f} photos, mean error {report['mean_error_px']:.2f} pixels"
    )


def write_report(
    path: Path, models: Sequence[Model], photos: Sequence[str], partners: dict[str, int], lines: list[str], **made: Any
) -> None:
    """convert_report.json: photos placed and left out, models found, cameras fitted, settings (`made`), advice."""
    chosen = models[0]
    content = {
        **made,
        "advice": lines,
        "cameras": chosen.cameras,
        "left_out": {name: {"partners": partners.get(name, 0)} for name in set(photos) - set(chosen.registered)},
        "mean_error_px": round(chosen.error, 4),
        "mean_track_length": round(chosen.track_length, 4),
        "model": chosen.folder,
        "models": [{"folder": m.folder, "photos": len(m.registered), "points": m.points} for m in models],
        "photos": len(photos),
        "points": chosen.points,
        "registered": len(chosen.registered),
    }
    write_json(path, content)
