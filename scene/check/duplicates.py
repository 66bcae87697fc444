"""Photos that are there twice, by name or by content: they count twice, or are scored after they have trained."""

import hashlib
import os
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from scene.check.findings import Finding
from scene.readers.info import CameraInfo, SceneInfo
from splatting.host.listing import some

_PART = 1 << 16  # bytes at the ends and in the middle that are compared first
_SAME_PLACE, _SAME_TURN = 0.02, 0.02  # extents, and radians: a pose that was found twice


def of_duplicates(info: SceneInfo, halves: bool = False) -> Iterator[Finding]:
    """Photos of several views. halves: test views are training views, too, on purpose."""
    train = info.train_cameras
    tests = [] if halves else list(info.test_cameras)
    groups = [group for group in _same_photos([*train, *tests]) if len(group) > 1]
    if not groups:
        return
    if len(groups[0]) == len(train) + len(tests):
        text, remedy = f"all {len(groups[0])} photos are the same picture", "restore the photos of the scene"
        yield Finding(text, remedy)
        return
    twice, leaked, elsewhere = [], [], []
    for group in groups:
        training, tested = ([n for n in group if (n >= len(train)) == test] for test in (False, True))
        views = [train[n] if n < len(train) else tests[n - len(train)] for n in group]
        if not all(_same_pose(views[0], view, info.extent or 1.0) for view in views[1:]):
            elsewhere.append(" and ".join(view.image_name for view in views[:2]))
        elif training and tested:
            leaked += [view.image_name for view, n in zip(views, group, strict=True) if n >= len(train)]
        else:
            twice.append(" and ".join(view.image_name for view in views[:2]))
    if leaked:
        text = f"{len(leaked)} of {len(tests)} test photos also train ({some(leaked)}), so their scores are too good"
        yield Finding(text, "take them out of one of the two lists")
    if elsewhere:
        text = f"the same picture belongs to cameras in different places ({some(elsewhere)})"
        yield Finding(text, "give each camera its own photo, or take one of the two out of the scene")
    if twice:
        text = f"photos are there twice ({some(twice)}), so they count twice"
        yield Finding(text, "take one of each out of the scene")


def _same_photos(views: Sequence[CameraInfo]) -> Iterator[list[int]]:
    """Indexes of views with the same photo, by file or by content."""
    by_path, by_size = defaultdict(list), defaultdict(list)
    for number, view in enumerate(views):
        if path := getattr(view, "image_path", None):
            by_path[os.path.realpath(path)].append(number)
    for path in by_path:
        try:
            by_size[os.path.getsize(path)].append(path)
        except OSError:
            by_size[path].append(path)  # of a reader that reads photos from elsewhere
    for size, paths in by_size.items():
        alike = _alike(paths, size) if len(paths) > 1 else [paths]
        yield from (sorted(n for path in group for n in by_path[path]) for group in alike)


def _alike(paths: Sequence[str], size: int) -> list[list[str]]:
    """Files of one size by their content."""
    parts = _by(paths, lambda path: _digest(path, size))
    return [group for same in parts for group in (_by(same, _whole) if len(same) > 1 and size > 3 * _PART else [same])]


def _by(paths: Sequence[str], key: Callable[[str], bytes]) -> list[list[str]]:
    groups = defaultdict(list)
    for path in paths:
        groups[key(path)].append(path)
    return list(groups.values())


def _digest(path: str, size: int) -> bytes:
    digest = hashlib.sha1(usedforsecurity=False)
    with open(path, "rb") as file:
        for place in (0, size // 2, max(size - _PART, 0)) if size > 3 * _PART else (0,):
            file.seek(place)
            digest.update(file.read(_PART if size > 3 * _PART else size))
    return digest.digest()


def _whole(path: str) -> bytes:
    return hashlib.sha1(Path(path).read_bytes(), usedforsecurity=False).digest()


def _same_pose(one: CameraInfo, other: CameraInfo, extent: float) -> bool:
    moved = np.linalg.norm(one.R @ one.T - other.R @ other.T)  # both rotations
    turned = np.arccos(np.clip((np.trace(one.R.T @ other.R) - 1) / 2, -1, 1))
    return moved < _SAME_PLACE * extent and turned < _SAME_TURN
