"""Choice of test photos (--eval): every eighth (--holdout every8), a sector or a block.

Every eighth photo has trained neighbours close by, which flatters a model; a sector and a block leave a gap.
"""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from scene.readers.info import HOLD, CameraInfo, camera_centers, from_above, up_of
from scene.readers.start_cloud import nearest_to_axes
from utils.system_utils import UserError

EVERY = "every8"
_WIDE = 2.0  # times the median sector; a wider one contains a gap that the cameras leave
_SAME = 5e-3  # of the usual distance of a camera; one that is no farther from another one stands at its place
_ROUNDED = 3  # decimals of degrees, so that cameras above each other have one angle


def split(
    cameras: list[CameraInfo], hold_out: bool, rule: str, folder: Path
) -> tuple[list[CameraInfo], list[CameraInfo]]:
    """Training and test views of cameras in the order of their names; without hold_out all train.

    rule: which are test views. "every8": every HOLD-th, the first included. "block": an eighth of them in succession,
    from the middle. "sector": see `_choose_sector`.
    """
    rules = {EVERY: lambda cameras: range(0, len(cameras), HOLD), "block": _choose_block, "sector": _choose_sector}
    tests = set(rules[rule](cameras) if hold_out and cameras else ())
    train = [camera for index, camera in enumerate(cameras) if index not in tests]
    test = held_out([camera for index, camera in enumerate(cameras) if index in tests])
    if not train:
        which, option = (f"every {HOLD}th", "--eval") if rule == EVERY else (f"a {rule}", f"--holdout {rule}")
        raise UserError(f"{folder} has too few photos for {option}, which holds out {which}; leave {option} out")
    return train, test


def held_out(cameras: Sequence[CameraInfo]) -> list[CameraInfo]:
    """The views, marked as test views."""
    return [replace(camera, is_test=True) for camera in cameras]


def refuse_rule(rule: str, listed: str | os.PathLike) -> None:
    """UserError for a rule where the scene lists its test photos itself, in the file `listed`."""
    if rule != EVERY:
        raise UserError(f"{listed} lists the test photos of this scene; leave --holdout {rule} out")


def _count_eighth(count: int) -> int:
    return max(2, (count + HOLD // 2) // HOLD)


def _choose_block(cameras: Sequence[CameraInfo]) -> range:
    count = _count_eighth(len(cameras))
    first = (len(cameras) - count) // 2
    return range(first, first + count)


def _choose_sector(cameras: Sequence[CameraInfo]) -> np.ndarray:
    """Indices of an eighth of the cameras, at least two, that lie in one sector about the point that all look at.

    The point is the nearest one to all optical axes; angles are about what is up for the cameras. The sector begins at
    the camera in the middle of the order of names and goes counter-clockwise, seen from above, until it has as many.
    Where the cameras leave a gap in it, or it would have twice as many, it begins at the next one by name whose sector
    has neither. So it is the same in any frame of the world. Cameras of its last angle all belong to it, and those that
    stand at the place of another one, as where a video pauses, do not count.
    """
    from scipy.spatial import cKDTree  # SciPy takes a while to import

    centers, turns = camera_centers(cameras), np.stack([camera.R for camera in cameras])
    found = nearest_to_axes(centers, turns[:, :, 2])
    if found is None:
        raise UserError("--holdout sector needs cameras that look at one place; take --holdout block")
    flat = (centers - found[0]) @ from_above(up_of(turns)).T
    angles = np.round(np.degrees(np.arctan2(flat[:, 1], flat[:, 0])), _ROUNDED) % 360
    least = _SAME * float(np.median(np.linalg.norm(centers - found[0], axis=1)))
    places = np.array([min(near) for near in cKDTree(centers).query_ball_point(centers, least)])
    angles, count, around = angles[places], len(cameras), np.sort(angles[np.unique(places)])
    ends = np.searchsorted(around, angles) + _count_eighth(len(around)) - 1
    widths = (around[ends % len(around)] - angles) % 360
    fits = widths <= _WIDE * np.median(widths[np.unique(places)])
    twice, last = np.sort(np.concatenate([angles, angles + 360])), widths + 0.1**_ROUNDED / 2
    sizes = np.searchsorted(twice, angles + last) - np.searchsorted(twice, angles)
    few = fits & (sizes <= 2 * _count_eighth(count))
    by_name = np.roll(np.arange(count), -(count // 2))
    first = by_name[(few if few.any() else fits)[by_name].argmax()]
    return np.flatnonzero((angles - angles[first]) % 360 <= last[first])
