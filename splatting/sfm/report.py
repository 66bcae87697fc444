"""Report of a conversion: the photos that were placed, and advice if the model is weak."""

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any, NamedTuple

from splatting.files.json_files import read_json, write_json
from splatting.host.listing import some
from splatting.sfm.layout import Layout
from splatting.sfm.mapping import is_wrong
from utils.system_utils import UserError

FEWEST_POINTS = 1000  # with fewer, density control has to find the scene by itself
SHORT_TRACKS = 3.0  # views per point; with fewer, most points depend on a single pair
LARGE_ERROR = 1.5, 1e-3  # pixels, and share of the longer side; a good model of sharp photos has 0.3 to 1 pixels


class Model(NamedTuple):
    """One model of the mapper. registered: names of photos; track_length: mean views per point; error: mean, pixels.

    cameras: id, model, size, params, and photos, by name what worker.py's _refit finds.
    """

    folder: str
    registered: list[str]
    points: int
    track_length: float
    error: float
    cameras: list[dict[str, Any]]


def read_tried(layout: Layout) -> list[dict[str, Any]]:
    """What mapping.py found of each way, the chosen one first; nothing where it did not judge."""
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


def refuse_nothing(models: Sequence[Model], images: Sequence[str], partners: dict[str, int], matcher: str) -> None:
    """Raise UserError with the likeliest reason if no model has a registered photo."""
    if models and models[0].registered:
        return
    matched = sum(count > 0 for count in partners.values())
    if matched < 2:
        reason = "no two of them show the same things sharply enough"
    else:
        reason = f"{matched} of them match another photo, but no pair has enough parallax or matches to start from"
    remedy = "take sharp, evenly lit photos that overlap by 60 to 80 %, from places some steps apart"
    if matcher == "sequential":
        remedy += ", or use --matcher auto"
    raise UserError(f"none of {len(images)} photos could be placed: {reason}; {remedy}")


def advice(
    models: Sequence[Model],
    images: Sequence[str],
    partners: dict[str, int],
    matcher: str,
    at_limit: int = 0,
    tried: Sequence[Mapping[str, Any]] = (),
    more_points: int = 0,
) -> list[str]:
    """Return one line for each weakness of the chosen model, models[0], that training will show.

    at_limit: --max_num_features if a photo reached it, else 0. tried: the models of mapping.py, the chosen one first.
    more_points: of dense_points.py.
    """
    chosen = models[0]
    against = list(tried[0].get("against", ())) if tried else []
    out = sorted(set(images) - set(chosen.registered) - set(against))
    lines = _of_judgement(tried[0], len(images)) if tried else []
    if out:
        lonely = sum(partners.get(name, 0) == 0 for name in out)
        text = f"{len(out)} of {len(images)} photos left out ({some(out)})"
        if lonely:
            text += f", {lonely} of them without a match in another photo"
        remedy = "take more photos on the way to the others, or remove what is blurred or shows something else"
        if matcher == "sequential":
            remedy += "; --matcher auto compares more than neighbours"
        lines.append(f"{text}; {remedy}")
    others = [len(model.registered) for model in models[1:] if set(model.registered) - set(chosen.registered)]
    if others:
        sizes = ", ".join(map(str, others))
        lines.append(
            f"the photos form {len(others) + 1} unconnected parts ({len(chosen.registered)} photos are used, "
            f"the other parts have {sizes}); take photos that lead from one part to the next, or try --cameras "
            "per_photo if they came through several lenses"
        )
    if chosen.points + more_points < FEWEST_POINTS:
        text = (
            f"only {chosen.points + more_points} points; a good start needs {FEWEST_POINTS}; use larger or more photos"
        )
        lines.append(text + (f", or --max_num_features {2 * at_limit}" if at_limit else ""))
    if chosen.track_length < SHORT_TRACKS:
        lines.append(
            f"a point is in {chosen.track_length:.1f} photos on average, so the photos overlap little; take more "
            "photos, each overlapping the one before by 60 to 80 %"
        )
    if _is_large(chosen):
        lines.append(
            f"the mean reprojection error is {chosen.error:.1f} pixels; if objects moved, mask them (--mask_path); if "
            "the photos come from several lenses, try --cameras per_photo; for a fisheye lens use --camera "
            "OPENCV_FISHEYE"
        )
    return lines


def _of_judgement(found: Mapping[str, Any], photos: int) -> list[str]:
    """What the matches say of the chosen model (mapping.py)."""
    lines, against = [], found.get("against", ())
    if not found.get("pairs") and "failed" not in found:
        lines.append(
            "the poses could not be judged, since no two photos have enough matches with known focal lengths; look at "
            "capture.html, or take more photos that overlap"
        )
    if is_wrong(found):
        lines.append(
            f"the poses contradict {found['contradicting']:.0%} of the matches that they were made from, so they are "
            "probably wrong; if the photos came through several lenses, or are zoomed or cropped, use --cameras "
            "per_photo; else remove photos of other things, and take more that overlap"
        )
    if against:
        lines.append(
            f"{len(against)} of {photos} photos left out ({some(against)}), since their matches contradict the others; "
            "if they came through another lens, or are zoomed or cropped, use --cameras per_photo; else remove them, "
            "and take more there"
        )
    return lines


def _is_large(model: Model) -> bool:
    """Whether the error is that of a weak model, in photos of its size."""
    pixels, share = LARGE_ERROR
    return model.error > max([pixels, *(share * max(camera["size"]) for camera in model.cameras)])


def advice_at_poses(model: Model, images: Sequence[str]) -> list[str]:
    """Return one line for each weakness of a model at given poses. UserError if the photos contradict the poses."""
    fit = f"{model.points} points, mean error {model.error:.1f} pixels"
    remedy = "check that the poses and lenses are of these photos"
    if model.points < len(model.registered):
        raise UserError(f"the photos do not fit the given poses ({fit}); {remedy}, or omit --poses")
    out, lines = sorted(set(images) - set(model.registered)), []
    if out:
        text = f"{len(out)} of {len(images)} photos have no pose in the file and were left out ({some(out)})"
        lines.append(f"{text}; add their poses, or omit --poses")
    if model.points < FEWEST_POINTS or _is_large(model):
        # Imported here: it loads torch, which no other conversion needs.
        from splatting.registry import tools

        remedies = "; ".join((remedy, *(remedy_of(True) for remedy_of in tools("for_wrong_poses"))))
        lines.append(f"the photos fit the given poses badly ({fit}); {remedies}")
    return lines


def summary(report: dict[str, Any]) -> str:
    """Summarise the contents of convert_report.json in one line."""
    return (
        f"{report['registered']} of {report['photos']} photos placed; {report['points']} points, each in "
        f"{report['mean_track_length']:.1f} photos, mean error {report['mean_error_px']:.2f} pixels"
        + (f"; {more} more points at these poses" if (more := report.get("more_points")) else "")
    )


def lens_words(report: dict[str, Any]) -> str:
    """Say in one line which photos convert_report.json is about: those of the lenses, or undistorted ones."""
    if report["lenses"] == "undistort":
        return "the scene has undistorted photos, with pinhole cameras"
    models = ", ".join(sorted({camera["model"] for camera in report["cameras"]}))
    return f"the scene has the photos as they are, with the cameras that were fitted ({models})"


def write_report(
    path: Path, models: Sequence[Model], images: Sequence[str], partners: dict[str, int], **made: Any
) -> None:
    """Write convert_report.json: photos placed and left out, models, and `made`: settings, cameras, advice."""
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
    write_json(path, content)


def report_inputs(path: Path, **inputs: Any) -> dict[str, Any]:
    """Return the contents of convert_report.json with entries about `input`, which may change without a new model."""
    content = read_json(path)
    if content != (whole := {**content, **inputs}):
        write_json(path, whole)
    return whole
