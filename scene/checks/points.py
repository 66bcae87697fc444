"""Checks of the points that a training starts from: few, in no photo, far away, several in one place."""

from collections.abc import Iterator

import numpy as np

from groundwork.finding import Finding, fine
from groundwork.host.listing import counted, some
from scene.checks.cameras import OTHER_FORMS
from scene.gaussians.copies import clusters_of
from scene.readers.info import SceneInfo, camera_centers
from scene.readers.tracks import projected

FEWEST_POINTS = 1000  # with fewer, density control has to find the scene by itself
FAR_POINT = 100.0  # extents from the cameras; a sky is some tens away
FAR_SHARE = 0.01
FEWEST_IN_VIEW = 10  # points of the cloud in a photo
_UNSEEN = 0.5
_OF_ANOTHER_FORM = 0.2  # share of the cameras without points
_SAMPLE = 5000  # most points tested against the views,
_TESTS = 1_000_000  # and most tests


def check_cloud(info: SceneInfo) -> Iterator[Finding]:
    """Check the number of points."""
    text = f"{len(info.point_cloud.points)} points to start from"
    if len(info.point_cloud.points) < FEWEST_POINTS:
        more = "start from more points (--init_pcd_path), or reconstruct with more photos or features"
        yield Finding(f"only {text}; {FEWEST_POINTS} or more are good", more)
    else:
        yield fine(text)


def check_points(info: SceneInfo) -> Iterator[Finding]:
    """Check the points; find nothing where there are none, as for a loaded model, or random ones."""
    if info.point_cloud is None or not len(info.point_cloud.points) or info.has_random_points:
        return
    points = np.asarray(info.point_cloud.points, dtype=np.float64)
    if not np.isfinite(points).all():
        return  # which is refused with the model's start
    yield from _find_far_points(points, info)
    yield from _find_unseen_points(points, info)
    places = clusters_of(points)
    if places.hides_spacing:
        text = f"{places.shared:.0%} of the {len(points)} points share a place with others"
        text += f", up to {places.counts.max()} in one"
        yield Finding(text, "remove the copies from the cloud, as a program that merges clouds may have left them")


def _find_far_points(points: np.ndarray, info: SceneInfo) -> Iterator[Finding]:
    """Find points far behind everything that the photos show."""
    away = np.linalg.norm(points - camera_centers(info.train_cameras).mean(axis=0), axis=1)
    far = (away > FAR_POINT * (info.extent or np.inf)).mean()
    if far > FAR_SHARE:
        text = f"{far:.1%} of the points are more than {FAR_POINT:g} extents away"
        yield Finding(text, "remove them from the cloud (COLMAP: filter by reprojection error and angle)")


def _find_unseen_points(points: np.ndarray, info: SceneInfo) -> Iterator[Finding]:
    """Find points in no photo, and photos without points."""
    count = min(_SAMPLE, max(200, _TESTS // len(info.train_cameras)))
    sample = points[:: max(1, len(points) // count)]
    seen = np.array([projected(camera, sample)[2] for camera in info.train_cameras])
    unseen = float((~seen.any(axis=0)).mean())
    counts = seen.sum(axis=1) * len(points) / seen.shape[1]
    away = [c.image_name for c, n in zip(info.train_cameras, counts, strict=True) if n < FEWEST_IN_VIEW]
    if len(points) < 2 * FEWEST_IN_VIEW:
        away = []
    text = f"hardly any point is in view of {counted(len(away), 'camera')} ({some(away)})"
    if unseen > _UNSEEN or len(away) >= max(2, _OF_ANOTHER_FORM * len(counts)):
        text = f"{unseen:.0%} of the points are in no photo" if unseen > _UNSEEN else text
        yield Finding(f"{text}: poses and points do not belong together", OTHER_FORMS)
    elif away:
        yield Finding(text, "remove them from the model: they face away from the scene, or their poses are wrong")
