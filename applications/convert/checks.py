"""Checks of a capture and its conversion: photos left out, poses that contradict their matches, photos to take again.

convert.py's report has their results, which train.py and doctor.py read. Several checks read the judgement of a model
(`found`), the JSON of worker.py's step judging. It compares pairs: two photos whose matches passed a geometric check of
the pair alone. A pair contradicts the model where its matches fit the model's poses much worse than they fit the pair's
own best geometry (scene/agreement.py).
"""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from groundwork.finding import Finding
from groundwork.host.listing import some
from scene.checks.fit import REFINE
from scene.checks.photo_files import blurred
from scene.checks.photos import SHARED_TEXT
from scene.checks.points import FEWEST_POINTS
from scene.images.exif import Lens
from scene.images.exposures import EXPOSURES
from utils.system_utils import UserError

if TYPE_CHECKING:
    from applications.convert.report import Model

SHORT_TRACKS = 3.0  # views per point; with fewer, most points depend on a single pair
LARGE_ERROR = 1.5, 1e-3  # pixels, and share of the longer side; a good model of sharp photos has 0.3 to 1 pixels
CONTRADICTING = 0.1  # share of the matches; right models had 0.09 at most, wrong ones 0.04 to 0.97
TURNED = 0.007  # of the longer side, rotation_error; in rooms 0.005 with 3 cm of noise, 0.014 with 10, which is placed
ALIKE = 0.05  # share of a model's photos that may stand among photos of other things, and are left out
LONELY = 3  # matching photos of a photo, with which its place is not known well
SOUND = 0.6  # share of a model's photos that have to agree, or it is called wrong
OTHER_LENS = 0.02  # difference of a photo's own focal length from its camera's; those of one lens have 0.017 at most
BETTER = 0.9  # of its error, that a photo of another lens falls below with a focal length of its own
LEAST = 0.6  # share of the photos, below which too few are placed
SHARED = 30  # points that a photo shares with another one that is near
FEW = 2  # such neighbours, with which a photo is weakly connected
_MANY = 0.05  # share of a camera's photos: a few may be wrong for other reasons
_FEWEST = 3
_MOST_GAPS = 3
_EXPOSURES = "--appearance ppisp"  # of train.py, for photos that differ by more
_BY_HAND = "--cameras per_photo, or put the photos of each lens into a sub-folder and use --cameras per_folder"
_OVERLAPPING = "each overlapping the one before by 60 to 80 %"


class Look(NamedTuple):
    """A photo's sharpness (photo_files.sharpness) and brightness (stops)."""

    sharpness: float
    brightness: float


def refuse_unplaced(models: "Sequence[Model]", images: Sequence[str], partners: dict[str, int], matcher: str) -> None:
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


def check_reconstruction(
    models: "Sequence[Model]",
    images: Sequence[str],
    partners: dict[str, int],
    matcher: str,
    at_limit: int = 0,
    tried: Sequence[Mapping[str, Any]] = (),
    more_points: int = 0,
    mode: str = "",
) -> Iterator[Finding]:
    """Find weaknesses of the chosen model, models[0], that training will show.

    images: names of all photos.
    partners: number of matching photos of each photo.
    at_limit: --max_num_features if a photo reached it, else 0.
    tried: the models of mapping.py, the chosen one first.
    more_points: number of points that dense_points.py has added.
    mode: --cameras.
    """
    chosen = models[0]
    against = list(tried[0].get("against", ())) if tried else []
    out = sorted(set(images) - set(chosen.registered) - set(against))
    if tried:
        yield from _check_judgement(tried[0], len(images), partners, mode)
        if is_only_turned(tried[0]) or is_folded(tried[0]):
            return  # what else is wrong comes of it
    if out:
        lonely = sum(partners.get(name, 0) == 0 for name in out)
        text = f"{len(out)} of {len(images)} photos left out ({some(out)})"
        text += f", {lonely} of them without a match in another photo" if lonely else ""
        remedy = "take photos on the way to the others, or remove from input what is blurred or shows something else"
        remedy += "; --matcher auto compares more than neighbours" if matcher == "sequential" else ""
        yield Finding(text, remedy)
    others = [len(model.registered) for model in models[1:] if set(model.registered) - set(chosen.registered)]
    if others:
        sizes = f"{len(chosen.registered)} photos are used, the other parts have {', '.join(map(str, others))}"
        remedy = "take photos that lead from one part to the next"
        remedy += _advise_per_photo(mode, ", or try --cameras per_photo if they came through several lenses")
        yield Finding(f"the photos form {len(others) + 1} unconnected parts ({sizes})", remedy)
    if (points := chosen.points + more_points) < FEWEST_POINTS:
        remedy = "use larger or more photos" + (f", or --max_num_features {2 * at_limit}" if at_limit else "")
        yield Finding(f"only {points} points; a good start needs {FEWEST_POINTS}", remedy)
    if chosen.track_length < SHORT_TRACKS:
        text = f"a point is in {chosen.track_length:.1f} photos on average, so the photos overlap little"
        yield Finding(text, f"take more photos, {_OVERLAPPING}")
    if _has_large_error(chosen):
        remedy = "if objects moved, mask them (--mask_path); for a fisheye lens use --camera OPENCV_FISHEYE"
        remedy += _advise_per_photo(mode, "; if the photos come from several lenses, try --cameras per_photo")
        yield Finding(f"the mean reprojection error is {chosen.error:.1f} pixels", remedy)


def _advise_per_photo(mode: str, text: str) -> str:
    """Return a text that advises --cameras per_photo; "" if that is the mode already."""
    return "" if mode == "per_photo" else text


def _check_judgement(
    found: Mapping[str, Any], photos: int, partners: Mapping[str, int], mode: str
) -> Iterator[Finding]:
    """Find weaknesses of the chosen model by the judgement of mapping.py, which compares poses and matches.

    photos: their number.
    partners: number of matching photos of each photo.
    """
    if is_only_turned(found):
        text = "the camera turned in one place, as rotations alone explain the matches, so the depths are not known"
        yield Finding(text, "walk, do not turn: take each photo some steps from the one before")
        return
    if is_folded(found):
        one, other = found["alike_pair"]
        text = f"parts that look alike are laid upon each other: {one} and {other} stand in one place, and show"
        text += " different things"
        yield Finding(text, "take photos that lead from one part to the other, or convert each part by itself")
        return
    if not found.get("pairs") and "failed" not in found:
        text = "the poses could not be judged, since no two photos have enough matches with known focal lengths"
        yield Finding(text, "look at capture.html, or take more photos that overlap")
    if is_wrong(found):
        matches = f"{found['contradicting']:.0%} of the matches that they were made from"
        remedy = _advise_per_photo(
            mode, "if photos are of several lenses, zoomed or cropped, use --cameras per_photo; else "
        )
        remedy += "remove photos of other things from input, and take more that overlap"
        yield Finding(f"the poses contradict {matches}, so they are probably wrong", remedy)
    lonely = [name for name in found.get("against", ()) if partners.get(name, 0) <= LONELY]
    if against := sorted(set(found.get("against", ())) - set(lonely)):
        text = f"{len(against)} of {photos} photos left out ({some(against)}), since their matches contradict the"
        remedy = _advise_per_photo(
            mode, "if they are of another lens, zoomed or cropped, use --cameras per_photo; else "
        )
        yield Finding(f"{text} others", f"{remedy}remove them from input, and take more there")
    if lonely:
        text = f"{len(lonely)} of {photos} photos left out ({some(lonely)}), since too few others match them"
        yield Finding(text, f"take more there, {_OVERLAPPING}")


def is_wrong(found: Mapping[str, Any]) -> bool:
    """Tell if a judged model is wrong, although it is the best one; a model without pairs cannot be judged.

    found: the judgement of the model, of which these entries count:
    pairs: number of pairs of photos;
    contradicting: share of the matches that belong to pairs which contradict the model, [0, 1];
    agreeing: number of photos in the largest group whose pairs agree with each other;
    photos: number of photos in the model;
    rotation, alike: see `is_only_turned` and `is_folded`, which make a model wrong as well.
    """
    if not found.get("pairs"):
        return False
    is_split = found["contradicting"] > CONTRADICTING or found["agreeing"] < SOUND * found["photos"]
    return is_split or is_only_turned(found) or is_folded(found)


def is_folded(found: Mapping[str, Any]) -> bool:
    """Tell if a judged model is folded: it lays different places that look alike upon each other.

    found: its entry `alike` has the photos to leave out so that no two stand in one place and show different things.
    """
    return len(found.get("alike", ())) > ALIKE * found.get("photos", 0)


def is_only_turned(found: Mapping[str, Any]) -> bool:
    """Tell if the camera of a judged model only turned in one place, so that no depth can be measured.

    found: its entry `rotation` has the error of the matches under rotations alone, as a share of a photo's longer side
    (None: not known); a small error means that the camera did not move.
    """
    error = found.get("rotation")
    return error is not None and error < TURNED


def _has_large_error(model: "Model") -> bool:
    """Tell if the reprojection error is larger than that of a good model, in photos of this size."""
    pixels, share = LARGE_ERROR
    return model.error > max([pixels, *(share * max(camera["size"]) for camera in model.cameras)])


def check_given_poses(model: "Model", images: Sequence[str]) -> Iterator[Finding]:
    """Find weaknesses of a model at given poses. UserError if the photos contradict the poses."""
    fit = f"{model.points} points, mean error {model.error:.1f} pixels"
    remedy = "check that the poses and lenses are of these photos"
    if model.points < len(model.registered):
        raise UserError(f"the photos do not fit the given poses ({fit}); {remedy}, or omit --poses")
    if out := sorted(set(images) - set(model.registered)):
        text = f"{len(out)} of {len(images)} photos have no pose in the file and were left out ({some(out)})"
        yield Finding(text, "add their poses, or omit --poses")
    if model.points < FEWEST_POINTS or _has_large_error(model):
        yield Finding(f"the photos fit the given poses badly ({fit})", f"{remedy}; {REFINE}")


def check_shared_cameras(
    cameras: Sequence[dict[str, Any]], known: dict[str, Lens], mode: str, frames: Collection[str] = ()
) -> Iterator[Finding]:
    """Find cameras whose photos seem to come through several lenses, and missing EXIF data.

    known: lenses by EXIF.
    mode: --cameras.
    frames: names of frames of videos, which never have EXIF data.
    """
    for camera in cameras:
        fits = {name: fit for name, fit in camera["photos"].items() if fit}
        other = [name for name, fit in fits.items() if _has_other_lens(*fit)]
        if len(other) >= max(_FEWEST, _MANY * len(fits)):
            factors = sorted(fits[name][0] for name in other)
            several = len({known.get(name) for name in camera["photos"]}) > 1
            yield Finding(
                f"{len(other)} of {len(camera['photos'])} photos that share a camera ({some(other)}) fit better with "
                f"{factors[0]:.2f} to {factors[-1]:.2f} times its focal length, as photos through several lenses, or "
                "zoomed or cropped ones do",
                "convert again with " + ("--cameras per_lens" if several else _BY_HAND),
            )
    photos = [name for name in known if name not in frames]
    silent = [name for name in photos if not known[name].is_distinct]
    if mode == "per_lens" and 0 < len(silent) < len(photos):
        text = f"the EXIF data of {len(silent)} of {len(photos)} photos name no lens ({some(silent)}), and those of"
        remedy = f"if they came through several lenses, use {_BY_HAND}"
        yield Finding(f"{text} one size and folder share a camera", remedy)


def _has_other_lens(factor: float, error: float, own_error: float) -> bool:
    return abs(factor - 1) > OTHER_LENS and own_error < BETTER * error


def find_neighbours(photos: Mapping[str, Mapping[str, Any]]) -> dict[str, list[str]]:
    """Find for each placed photo the others with which it shares enough points, those with most points first."""
    return {
        name: [other for other, count in sorted(photo["shared"].items(), key=lambda one: -one[1]) if count >= SHARED]
        for name, photo in photos.items()
    }


def rate_capture(
    report: Mapping[str, Any], photos: Mapping[str, Mapping[str, Any]], looks: Mapping[str, Look]
) -> dict[str, Any]:
    """Find the weak photos of a capture, and what to photograph again; return entries for convert_report.json.

    report: the entries of convert_report.json so far.
    photos: the entry of each placed photo in capture.json, by name.
    looks: sharpness and brightness of all photos, from `compare_brightness`.

    Returns a dict:

    weakly_connected: names of placed photos that share points with too few others.
    blurred: names of photos.
    brightness_spread_stops: standard deviation of the placed photos' brightness, in stops; None: not known.
    again: a sentence for each thing to photograph again.
    """
    neighbours = find_neighbours(photos)
    against = {name for found in report.get("tried", [])[:1] for name in found.get("against", ())}
    weak = sorted(name for name, others in neighbours.items() if len(others) < min(FEW, len(photos) - 1))
    soft = blurred({name: look.sharpness for name, look in looks.items()})
    bright = [look.brightness for name, look in looks.items() if name in photos and math.isfinite(look.brightness)]
    spread = round(float(np.std(bright)), 3) if bright else None
    if any(SHARED_TEXT in line for line in report.get("advice", ())):  # why photos are left out or weakly connected
        again = _list_retakes([], [], [], soft, spread)
    else:
        gaps = find_gaps(report["left_out"], photos)
        others = [
            name
            for name in sorted(set(report["left_out"]) - against)
            if not any(before < name < after for _, before, after in gaps)
        ]
        again = _list_retakes(gaps, others, weak, soft, spread)
    return {
        "weakly_connected": weak,
        "blurred": soft,
        "brightness_spread_stops": spread,
        "again": again,
    }


def _list_retakes(
    gaps: list[tuple[int, str, str]], left_out: list[str], weak: list[str], soft: list[str], spread: float | None
) -> list[str]:
    """List sentences on what to photograph again, one for each kind of fault.

    gaps: number of unplaced photos, and the names of the placed photos before and after them.
    left_out: names of other photos without a pose.
    weak: names of photos with few neighbours.
    soft: names of blurred photos.
    spread: standard deviation of the brightness, in stops; None: not known.
    """
    lines = [
        f"Take photos between {before} and {after}: {count} there could not be placed" for count, before, after in gaps
    ]
    if left_out:
        lines.append(
            f"Take photos on the way from {some(left_out)} to the others, {_OVERLAPPING}: "
            f"{'this one' if len(left_out) == 1 else 'these'} could not be placed"
        )
    if weak:
        lines.append(f"Take more photos around {some(weak)}: fewer than {FEW} other photos share points with each")
    if soft:
        lines.append(f"Hold the camera still, or add light, for {some(soft)}: blurred")
    if spread and spread > EXPOSURES:
        lines.append(
            f"Use a fixed exposure, if you can: the photos' brightness differs by {spread:.1f} stops; train these "
            f"with {_EXPOSURES}"
        )
    return lines


def find_gaps(left_out: Collection[str], placed: Collection[str]) -> list[tuple[int, str, str]]:
    """Find runs of several left-out photos between two placed ones, by name and within a folder.

    Returns the _MOST_GAPS longest runs, longest first: number of photos, and the placed photos before and after.
    """
    found = []
    for _, names in groupby(sorted({*left_out, *placed}), lambda name: PurePosixPath(name).parent):
        before, count = "", 0
        for name in names:
            if name in left_out:
                count += 1
                continue
            if before and count > 1:
                found.append((count, before, name))
            before, count = name, 0
    return sorted(found, key=lambda gap: -gap[0])[:_MOST_GAPS]


def describe_capture(report: Mapping[str, Any]) -> list[str]:
    """Describe overlap, blur and brightness of a capture, and say which photos to take again, a line for each."""
    weak, soft = report["weakly_connected"], report["blurred"]
    lines = []
    if weak or not why_unusable(report):
        few = f"{len(weak)} of {report['registered']} photos weakly connected ({some(weak)})"
        lines.append(f"overlap: {few if weak else 'no photo is weakly connected'}")
    said = f"{len(soft)} of {report['photos']} photos blurred ({some(soft)})"
    lines.append(f"blur: {said if soft else 'no photo is blurred'}")
    if (spread := report["brightness_spread_stops"]) is not None:
        lines.append(f"brightness: the photos differ by {spread:.2f} stops")
    return [*lines, *report["again"]]


def training_options(report: Mapping[str, Any]) -> str:
    """Return the options of train.py that lines of the report advise; "" if there are none."""
    return _EXPOSURES if any(_EXPOSURES in line for line in report["again"]) else ""


def why_unusable(report: Mapping[str, Any]) -> str | None:
    """Return the reason why a scene should not be trained: few photos are placed, or poses are wrong; None: it can."""
    placed, count = report["registered"], report["photos"]
    if report.get("tried") and is_only_turned(report["tried"][0]):
        return "the camera turned in one place, so do not train on this scene; walk, do not turn"
    if report.get("tried") and is_folded(report["tried"][0]):
        return "parts that look alike are laid upon each other in it, so do not train on this scene"
    if report.get("tried") and is_wrong(report["tried"][0]):
        return "no way of mapping found poses that agree with the photos' matches, so do not train on this scene"
    if placed >= LEAST * count:
        return None
    return (
        f"only {placed} of {count} photos are placed, so the scene is incomplete; capture.html in it says which photos "
        "to take"
    )
