"""Checks of photo files: duplicates, which count twice or are scored after they have trained, and blur.

Blur removes more of the fine detail than of the coarse detail of a photo: see `sharpness`.
"""

import hashlib
import os
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from groundwork.files.color_profiles import to_srgb
from groundwork.files.image_files import UNREADABLE, open_image, to_eight_bits
from groundwork.finding import Finding
from groundwork.host.listing import some
from scene.readers.info import CameraInfo, SceneInfo
from utils.system_utils import UserError

_PART = 1 << 18  # bytes at the ends and in the middle that are compared
_SAME_PLACE, _SAME_TURN = 0.02, 0.02  # extents, and radians: a pose that was found twice
_WIDTH = 640  # pixels at which photos are compared, as sharpness depends on it
_COARSE = 4  # pixels
_DIRECTIONS = np.array([(0, 1), (1, 0), (1, 1), (1, -1)])
# Of the third quartile of a scene's sharpness. Sharp photos have 0.41 and more, those smeared over 12 of 240 pixels 0.1
# to 0.2.
_BLURRED = 0.25


def check_duplicates(info: SceneInfo, halves: bool = False) -> Iterator[Finding]:
    """Find photos that several views have. halves: test views are also training views, on purpose."""
    train = info.train_cameras
    tests = [] if halves else list(info.test_cameras)
    groups = [group for group in _find_same_photos([*train, *tests]) if len(group) > 1]
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


def _find_same_photos(views: Sequence[CameraInfo]) -> Iterator[list[int]]:
    """Indexes of views with the same photo, by file or by content."""
    by_size, by_content = defaultdict(lambda: defaultdict(list)), defaultdict(list)
    for number, view in enumerate(views):
        if path := getattr(view, "image_path", None):
            # A reader may read its photos from elsewhere.
            by_size[os.path.getsize(path) if os.path.isfile(path) else path][os.path.realpath(path)].append(number)
    for size, paths in by_size.items():
        for path, numbers in paths.items():
            by_content[size, _hash_parts(path, size) if len(paths) > 1 else path] += numbers
    for (size, _), numbers in by_content.items():
        whole = defaultdict(list)  # photos without compression share much
        for number in numbers:
            certain = len(numbers) < 2 or not isinstance(size, int) or size <= 3 * _PART
            path = Path(views[number].image_path)
            whole[b"" if certain else hashlib.sha1(path.read_bytes(), usedforsecurity=False).digest()].append(number)
        yield from map(sorted, whole.values())


def _hash_parts(path: str, size: int) -> bytes:
    """Hash the start, the middle and the end of a file of `size` bytes."""
    digest = hashlib.sha1(usedforsecurity=False)
    with open(path, "rb") as file:
        for place in (0, size // 2, max(size - _PART, 0)):
            file.seek(place)
            digest.update(file.read(_PART))
    return digest.digest()


def _same_pose(one: CameraInfo, other: CameraInfo, extent: float) -> bool:
    moved = np.linalg.norm(one.R @ one.T - other.R @ other.T)  # both rotations
    turned = np.arccos(np.clip((np.trace(one.R.T @ other.R) - 1) / 2, -1, 1))
    return moved < _SAME_PLACE * extent and turned < _SAME_TURN


def check_blur(info: SceneInfo, most: int) -> Iterator[Finding]:
    """Find blurred photos, among at most `most` in a random order."""
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


def small(path: Path, side: int = _WIDTH) -> np.ndarray:
    """A photo (H, W, 3) uint8 in sRGB, with at most `side` pixels a side."""
    with open_image(path) as image:
        return shrunk(image, "RGB", side)


def shrunk(image: Image.Image, mode: str, side: int) -> np.ndarray:
    """An image (H, W, channels) uint8 in sRGB and Pillow's `mode`, with at most `side` pixels a side."""
    image.draft("RGB", (side, side))  # decodes a large JPEG at a fraction of its size
    pixels = to_srgb(image)
    pixels = (to_eight_bits(pixels) if pixels.mode.startswith("I") else pixels).convert(mode)
    pixels.thumbnail((side, side))
    return np.asarray(pixels)


def sharpness(pixels: np.ndarray) -> float:
    """The share of fine detail of a photo, in the direction where it is least: motion blurs along one direction.

    The share is the energy of second differences (after Nayar and Nakagawa 1994) at a distance of one pixel, over the
    energy at _COARSE. NaN: the photo has no detail.

    pixels: (H, W, 3), 0 to 255.
    """
    grey = pixels.mean(2, dtype=np.float32)
    if min(grey.shape) <= 2 * _COARSE:
        return np.nan
    energies = ((_measure_curvature(grey, step), _measure_curvature(grey, step * _COARSE)) for step in _DIRECTIONS)
    return min((fine / coarse for fine, coarse in energies if coarse > 0.5), default=np.nan)


def _measure_curvature(grey: np.ndarray, step: np.ndarray) -> float:
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
