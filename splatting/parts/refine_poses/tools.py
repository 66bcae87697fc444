"""Whether tracks of a scene ask for other poses."""

from collections.abc import Iterator, Sequence

from scene.readers.tracks import Track
from scene.scene import Scene
from splatting.findings import Finding, note
from splatting.findings.fit import pose_errors, poses_differ


def advise(scene: Scene, tracks: Sequence[Track | None]) -> Iterator[Finding]:
    """Numbers of a scene, and the options that they speak for."""
    found = pose_errors(scene.info.train_cameras, tracks, scene.cameras_extent) if any(tracks) else None
    if found is not None:
        given, best = found
        text = f"points lie {given:.2g} pixels from where photos show them (median), and {best:.2g} with better poses"
        yield note(text, "--refine_poses" if poses_differ(given, best) else "")


def for_wrong_poses(best: bool) -> str:
    """What to do where points are not where photos show them. best: other poses would fit far better."""
    return "train with --refine_poses" if best else "--refine_poses corrects 3 degrees at most"
