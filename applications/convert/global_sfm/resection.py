"""Photos that contradict the others are taken out of the poses, and placed again by the points that the others see."""

from collections.abc import Mapping

import numpy as np
import pycolmap

from applications.convert.global_sfm.matches import Matches
from applications.convert.global_sfm.tracks import Tracks, Views
from scene.agreement import WORSE, consistent_groups

_HEARD = 100  # matches of a pair that count
_FEWEST = 15  # points by which a photo is placed, and
_SHARE = 0.25  # share of its points that fit


def keep_consistent(matches: Matches, errors: np.ndarray, own: np.ndarray, floors: np.ndarray, views: Views) -> None:
    """Take out the poses of photos that are not in the largest group whose pairs agree.

    As in scene/agreement.py, a pair contradicts where the median of its errors (M,) under the poses is much larger than
    under its own pose, (P,), and above a floor (P,); all in radians.
    """
    inside = views.posed[matches.pairs].all(1)
    contradicts = median_of_pairs(matches, errors) > np.maximum(WORSE * own, floors)
    votes = np.where(contradicts, -1, 1) * np.minimum(np.bincount(matches.pair), _HEARD)
    groups = consistent_groups(zip(*matches.pairs[inside].T.tolist(), votes[inside].tolist(), strict=True))
    views.posed[:] = False
    views.posed[groups[0] if groups else []] = True


def median_of_pairs(matches: Matches, errors: np.ndarray) -> np.ndarray:
    """Return the median (P,) of the errors (M,) of each pair's matches."""
    counts = np.bincount(matches.pair)
    ordered = errors[np.lexsort((errors, matches.pair))]
    return ordered[np.cumsum(counts) - counts + counts // 2]


def resect(
    matches: Matches,
    cameras: Mapping[int, pycolmap.Camera],
    tracks: Tracks,
    points: np.ndarray,
    views: Views,
    limit: float,
) -> bool:
    """Place photos without a pose by their matches with features of points (P, 3); tell if there was one.

    limit: pixels that a point may be off.
    """
    point = np.full(len(matches.places), -1)
    point[tracks.features] = tracks.track
    both = np.concatenate([matches.features, matches.features[:, ::-1]])  # of a photo, and of another with a point
    both = both[(point[both[:, 1]] >= 0) & ~views.posed[matches.photo[both[:, 0]]]]
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error, options.ransac.random_seed = limit, 0
    is_changed = False
    for photo in np.unique(matches.photo[both[:, 0]]):
        seen = both[matches.photo[both[:, 0]] == photo]
        seen = np.unique(np.stack([seen[:, 0], point[seen[:, 1]]], 1), axis=0)
        camera = cameras[matches.images[photo].camera_id]
        found = pycolmap.estimate_and_refine_absolute_pose(
            matches.places[seen[:, 0]], points[seen[:, 1]], camera, options
        )
        if found and found["num_inliers"] >= max(_FEWEST, _SHARE * len(seen)):
            pose = found["cam_from_world"]
            views.rotations[photo] = pose.rotation.matrix()
            views.places[photo] = -views.rotations[photo].T @ pose.translation
            views.posed[photo] = is_changed = True
    return is_changed
