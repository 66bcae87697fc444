"""Pixels that nearly all photos share: black corners, a caption, a logo, a bonnet, a still background of a turntable.

A region of one colour may also be a plain background, but then its outline changes from photo to photo.
"""

import numpy as np

_FEWEST = 5  # photos that differ from each other
_NEARLY_ALL = 0.9  # of the photos
_NEAR = 12  # of 255, that noise and JPEG change a pixel by
_EQUAL = 0.98  # share of equal pixels of two photos of a burst
_STEP = 4  # pixels, between those that tell such photos
_LEAST = 0.01  # share of the photo
_SPECK = 0.0005  # share of the photo; a smaller region is left out
BORDER = 2  # pixels beside a region, which is blurred there
_SHARP = 0.5  # share of the pixels beside a region that differ from photo to photo
_PLAIN = 0.8  # share of a region that is of one colour
_SIDES = {"top": {0, 1, 2}, "bottom": {6, 7, 8}, "left": {0, 3, 6}, "right": {2, 5, 8}}
_CELLS = ("top left", "top", "top right", "left", "middle", "right", "bottom left", "bottom", "bottom right")


def shared_pixels(photos: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Pixels (h, w) bool that nearly all photos share; none if they are too few.

    photos: (n, h, w, 3) uint8. seen: (n, h, w) bool, the pixels that count.
    """
    photos = photos.astype(np.int16)
    differing, few = [], photos[:, ::_STEP, ::_STEP]
    for n, photo in enumerate(few):
        if all((_measure_difference(photo, few[k]) <= _NEAR).mean() < _EQUAL for k in differing):
            differing.append(n)
    found = np.zeros(photos.shape[1:3], bool)
    if len(differing) < _FEWEST:
        return found
    usual = np.median(photos[differing], axis=0)
    agreeing = ((_measure_difference(photos[differing], usual) <= _NEAR) & seen[differing]).mean(0)
    equal = agreeing >= _NEARLY_ALL
    if equal.mean() < _LEAST:
        return found
    from scipy import ndimage  # it takes a while to import

    regions, _ = ndimage.label(equal, np.ones((3, 3)))
    for number, size in enumerate(np.bincount(regions.ravel())[1:], 1):
        if size < _SPECK * equal.size:
            continue
        region = regions == number
        inner, outer = (ndimage.binary_dilation(region, iterations=BORDER * times) for times in (1, 2))
        beside = agreeing[outer & ~inner & ~equal]
        colors = usual[region]
        is_plain = (_measure_difference(colors, np.median(colors, axis=0)) <= 2 * _NEAR).mean() > _PLAIN
        if not is_plain or (beside.size and (beside < 0.5).mean() > _SHARP):
            found |= region
    return found if found.mean() >= _LEAST else np.zeros_like(found)


def _measure_difference(colors: np.ndarray, others: np.ndarray) -> np.ndarray:
    """The largest difference of a channel, of colours (..., 3)."""
    return np.abs(colors - others).max(-1)


def place_of(shared: np.ndarray) -> str:
    """Say in words where in the photo pixels (h, w) bool lie."""
    blocks = [block for rows in np.array_split(shared, 3) for block in np.array_split(rows, 3, axis=1)]
    cells = {n for n, block in enumerate(blocks) if block.mean() > max(0.05, 0.25 * shared.mean())}
    if cells == {0, 2, 6, 8}:
        return "in the corners"
    if len(cells) >= 8:
        return "all around" if 4 not in cells else "all over"
    sides = [side for side, whole in _SIDES.items() if whole <= cells]
    rest = cells.difference(*(_SIDES[side] for side in sides))
    return "at the " + " and ".join([*sides, *(_CELLS[n] for n in sorted(rest))])
