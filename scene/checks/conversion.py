"""Checks of a scene that convert.py made: its stages, photos left out, and photos changed since."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from groundwork.files.json_files import read_json
from groundwork.finding import Finding, fine, note
from groundwork.host import torchrun
from groundwork.host.listing import some
from scene.readers.scene_folder import REPORT, WORK, describe_verdict, find_capture, is_scene, is_unrelated

REGISTERED = 0.9  # share of the photos that a good conversion places


def file_state(path: Path) -> list[Any]:
    """Describe a file, so that changes show: name, bytes, time of the last change."""
    stat = path.stat()
    return [path.name, stat.st_size, stat.st_mtime_ns]


def read_stages(source: str | os.PathLike) -> dict[str, Any]:
    """Read the record of the last conversion in a folder, stages.json; {} if it is missing or damaged.

    Each stage has `done` and `made_from`; the notes `options` and `files` are those of that conversion.
    """
    try:
        return {name: dict(entry) for name, entry in read_json(Path(source) / WORK / "stages.json").items()}
    except (OSError, ValueError, TypeError, AttributeError, RecursionError):
        return {}


def is_unfinished(source: str | os.PathLike) -> bool:
    """Return True if a conversion was begun in a folder, and ended before its last stage."""
    return bool(found := read_stages(source)) and not found.get("capture", {}).get("done")


def awaits_conversion(source: str | os.PathLike) -> bool:
    """Return True if train.py should run convert.py first: on photos or videos without cameras, or to end a conversion.

    False for one of several processes of torchrun, and for a folder that is part of a scene.
    """
    folder = Path(source)
    if not folder.is_dir() or torchrun.size() > 1 or (is_scene(folder) and not is_unfinished(folder)):
        return False
    if read_stages(folder):
        return True
    found = find_capture(folder.absolute())
    return is_unrelated(folder) and bool(found.photos or found.videos or os.path.lexists(folder / "input"))


def describe_changed_photos(source: str | os.PathLike) -> str | None:
    """Say which photos of a scene that convert.py made are new, gone or changed since; None: none."""
    stages, found = read_stages(source), find_capture(Path(source))
    try:
        before = dict(stages["files"]["made_from"])
        ignored = set(read_json(Path(source) / REPORT)["unused"])
    except (OSError, LookupError, TypeError, ValueError):
        return None
    paths = {name: path for name in before for path in (Path(source, name), found.place / name) if path.is_file()}
    there = {name: file_state(path) for name, path in paths.items()}
    if not there or is_unfinished(source):
        return None
    changed = [name for name, state in there.items() if state != before[name]]
    if len(changed) == len(there) and all(state[:2] == before[name][:2] for name, state in there.items()):
        changed = []  # the folder is a copy
    now = {path.relative_to(found.place).as_posix() for path in found.photos}
    kinds = {"new": now - set(before) - ignored, "gone": set(before) - set(there), "changed": changed}
    said = [f"{len(names)} {kind} ({some(sorted(names))})" for kind, names in kinds.items() if names]
    text = f"photos have changed since this scene was converted: {', '.join(said)}; to take this over, run convert.py "
    return f"{text}again, with the options that it had" if said else None


def describe_left_out(source: str | os.PathLike) -> str | None:
    """Describe the photos that convert.py could not place; None if it placed all, or did not make the scene."""
    if said := describe_verdict(source):
        return said
    try:
        report = read_json(Path(source) / REPORT)
        placed, count = int(report["registered"]), int(report["photos"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    share = f"{placed} of {count} photos ({placed / max(count, 1):.0%})"
    return f"this scene has {share} of its capture; capture.html in it says what is missing" if placed < count else None


def has_undistorted_photos(source: str | os.PathLike) -> bool:
    """Tell whether convert.py has undistorted the photos of the scene."""
    try:
        return read_json(Path(source) / REPORT)["lenses"] == "undistort"
    except (OSError, ValueError, KeyError, TypeError):
        return False


def check_conversion(source: str | os.PathLike) -> Iterator[Finding]:
    """Check the number of photos that convert.py has placed, if it made the scene."""
    path = Path(source) / REPORT
    if is_unfinished(source):
        yield Finding("a conversion of this scene was not finished", "train.py finishes it, or run convert.py again")
    if text := describe_changed_photos(source):
        yield note(text)
    if not path.is_file():
        return
    try:
        report = read_json(path)
        placed, photos = int(report["registered"]), int(report["photos"])
        advice = [str(line) for line in report["advice"]]
    except (OSError, ValueError, KeyError, TypeError):
        yield Finding(f"{path} is damaged", "remove it, or run convert.py again")
        return
    if verdict := describe_verdict(source):
        yield Finding(verdict, "do what its page advises, and convert again")
        return
    text = f"{placed} of {photos} photos were placed by convert.py"
    remedy = advice[0].rpartition("; ")[2] if advice else "take more photos that overlap"
    few = photos and placed / photos < REGISTERED
    yield Finding(f"only {text}", remedy) if few else fine(text)
