"""Files of photos: the same photo twice, which counts twice or is scored after it has trained, damaged JPEGs, and blur.

Decoders pass over damage in the middle of a JPEG: what follows is in wrong colours and places. Where the coded data end
too early, or are zeros, they repeat the last colour: blocks of 8 pixels a side that are exactly equal, in long runs,
which photos have none of.

Blur takes fine detail more than coarse detail of the same photo, whatever it shows: see `sharpness`.
"""

import hashlib
import os
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median

import numpy as np

from scene.readers.info import CameraInfo, SceneInfo
from splatting.files.color_profiles import in_srgb
from splatting.files.image_files import UNREADABLE, eight_bits, open_image
from splatting.findings import Finding
from splatting.host.listing import some
from utils.system_utils import UserError

_PART = 1 << 16  # bytes at the ends and in the middle that are compared first
_SAME_PLACE, _SAME_TURN = 0.02, 0.02  # extents, and radians: a pose that was found twice
_LOOKED_THROUGH = 4_000_000  # pixels that are looked through for damage, for each photo that is decoded
_RUN = 16  # blocks
_SHARE = 0.02  # of the blocks; sound photos have 0.0075 at most, grey ones 0.016, a file that lost a fifteenth 0.04
_USUAL = 8  # times the photos' median; sound ones of a low quality have 0.12 and 7.5 times that
_CLIPPED = 8  # of 255, from black and white, which photos have much of
_FEW = 0.25  # of the photos; where more have it, it is a background
_WIDTH = 640  # pixels at which photos are compared, as sharpness depends on it
_COARSE = 4  # pixels
_DIRECTIONS = np.array([(0, 1), (1, 0), (1, 1), (1, -1)])
# Of the third quartile of a scene's sharpness. Sharp photos have 0.41 and more, those smeared over 12 of 240 pixels 0.1
# to 0.2.
_BLURRED = 0.25


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


def of_damage(info: SceneInfo, most: int) -> Iterator[Finding]:
    """Damaged photos, among some in a random order; among all of a few small ones."""
    views, left, shares = info.train_cameras, most * _LOOKED_THROUGH, {}
    for number in np.random.default_rng(0).permutation(len(views)):
        path = getattr(views[number], "image_path", None)  # readers of others may have photos elsewhere
        shares[views[number].image_name], pixels = equal_share(Path(path)) if path else (None, 0)
        left -= pixels
        if left < 0:
            break
    yield from damaged(shares)


def damaged(shares: Mapping[str, float | None]) -> Iterator[Finding]:
    """Photos that are likely damaged, by their `equal_share`."""
    known = {name: share for name, share in shares.items() if share is not None}
    least = max(_SHARE, _USUAL * median(known.values() or [0]))
    found = sorted(name for name, share in known.items() if share > least)
    if 0 < len(found) <= _FEW * len(known):
        text = f"{len(found)} of the {len(known)} JPEG photos that were checked are likely damaged in the middle"
        text += f", as parts of them are of exactly one colour ({some(found)})"
        yield Finding(text, "copy them again, or take them out of the scene")


def of_blur(info: SceneInfo, most: int) -> Iterator[Finding]:
    """Blurred photos, among at most `most` in a random order."""
    found = {}
    for number in np.random.default_rng(0).permutation(len(info.train_cameras))[:most]:
        view = info.train_cameras[number]
        try:
            found[view.image_name] = sharpness(small(Path(getattr(view, "image_path", ""))))
        except (*UNREADABLE, UserError):
            continue  # of a reader that reads photos from elsewhere
    if soft := blurred(found):
        text = f"{len(soft)} of the {len(found)} photos that were checked look blurred ({some(soft)})"
        yield Finding(text, "take them out of the scene if others show the same; hold the camera still, or add light")


def small(path: Path) -> np.ndarray:
    """A photo (H, W, 3) uint8 in sRGB, of the size at which photos are compared."""
    with open_image(path) as image:
        image.draft("RGB", (_WIDTH, _WIDTH))
        pixels = in_srgb(image)
        pixels = (eight_bits(pixels) if pixels.mode.startswith("I") else pixels).convert("RGB")
        pixels.thumbnail((_WIDTH, _WIDTH))
        return np.asarray(pixels)


def sharpness(pixels: np.ndarray) -> float:
    """How much of a photo's detail is fine, along the direction in which that is least, as motion blurs along one.

    pixels: (H, W, 3), 0 to 255. It is the energy of second differences (after Nayar and Nakagawa 1994) at a distance of
    one pixel over that at _COARSE. NaN: the photo has no detail.
    """
    grey = pixels.mean(2, dtype=np.float32)
    if min(grey.shape) <= 2 * _COARSE:
        return np.nan
    energies = ((_curvature(grey, step), _curvature(grey, step * _COARSE)) for step in _DIRECTIONS)
    return min((fine / coarse for fine, coarse in energies if coarse > 0.5), default=np.nan)


def _curvature(grey: np.ndarray, step: np.ndarray) -> float:
    """Mean square of second differences at a step (rows, columns)."""
    margin = np.abs(step)

    def moved(times: int) -> np.ndarray:
        (top, left), (height, width) = margin + times * step, grey.shape - 2 * margin
        return grey[top : top + height, left : left + width]

    return float(np.square(2 * moved(0) - moved(-1) - moved(1)).mean())


def blurred(found: Mapping[str, float]) -> list[str]:
    """Names of blurred photos, by the `sharpness` of all. They may be half of them."""
    known = [value for value in found.values() if np.isfinite(value)]
    middle = np.quantile(known, 0.75, method="lower") if known else 0.0
    return sorted(name for name, value in found.items() if value < _BLURRED * middle)


def equal_share(path: Path) -> tuple[float | None, int]:
    """Share of a JPEG's blocks in runs that are exactly equal, and its pixels; None of another file or a broken one."""
    try:
        with open_image(path) as image:
            if image.format not in ("JPEG", "MPO"):
                return None, 0
            size = image.width * image.height
            image.draft("RGB", (1, 1))  # a pixel a block
            return _flat(np.asarray(image.convert("RGB"), np.int16)), size
    except UNREADABLE:
        return None, 0


def _flat(blocks: np.ndarray) -> float:
    """Share of blocks (h, w, 3) in runs along a row that are exactly equal, and neither black nor white."""
    run = max(4, min(_RUN, blocks.shape[1] // 8))
    if blocks.shape[1] <= run:
        return 0.0
    same = np.lib.stride_tricks.sliding_window_view((np.diff(blocks, axis=1) == 0).all(2), run - 1, axis=1).all(2)
    flat = np.zeros(blocks.shape[:2], bool)
    for shift in range(run):
        flat[:, shift : shift + same.shape[1]] |= same
    return float((flat & (blocks.max(2) >= _CLIPPED) & (blocks.min(2) <= 255 - _CLIPPED)).mean())
