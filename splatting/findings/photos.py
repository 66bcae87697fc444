"""Faults of photos: invisible ones, nearly one value, a part of the range, bars, masks that leave out everything."""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from scene.images.decode import picture_size
from scene.images.masks import Mask
from scene.readers.info import CameraInfo, SceneInfo
from splatting.files.color_profiles import in_srgb
from splatting.files.image_files import UNREADABLE, open_image
from splatting.findings import Finding, Severity, fine
from splatting.host.listing import some
from utils.system_utils import UserError

FEWEST_VIEWS = 20
_WIDE = 1600  # pixels
SMALL = 32  # pixels; a smaller side has few more than SSIM's window
NARROW = 1 / 16  # of the range, which 12 bits in 16 use; less is hardly more than one value
_PIXELS = 200  # a side, of what is looked at
_MOST_DECODED = 25_000_000  # pixels of all photos; a JPEG is decoded at an eighth of its size
_JPEG = 1 / 6  # cost of its pixels
_FEWEST = 3  # photos
_VISIBLE = 26  # of 255, an alpha that shows something
_OPAQUE = 230
_SOME = 0.001  # share of the pixels that has to be seen
_BAR = 0.01  # of a side, of a bar along an edge
_EQUAL = 12 / 255  # difference of colours in a bar
_ENDS = 2  # pixels between a bar and what is beside it, as it may be blurred
_WITH_BARS = 0.8  # share of the photos that have to have the same bars
_PARTLY = 0.5  # share of visible pixels; edges, hair and smoke have less


class Look(NamedTuple):
    """What a small photo shows: per channel, the range (2, 3) of the pixels that count, of full scale 1.

    alpha: (K,) of 255, None where all is opaque. kept: share of the pixels that the mask keeps. seen: share that is
    visible and kept. values: different values of a channel, at most. sixteen: a grey photo of 16 bits. bars (4,): at
    the top, right, bottom and left, of the height or width.
    """

    name: str
    range: np.ndarray
    alpha: np.ndarray | None
    kept: float
    seen: float
    values: int
    sixteen: bool
    bars: np.ndarray

    @property
    def width(self) -> float:
        """The largest part of the range that a channel uses."""
        return float((self.range[1] - self.range[0]).max())

    @property
    def is_visible(self) -> bool:
        """Whether alpha lets anything be seen."""
        return self.alpha is None or (self.alpha >= _VISIBLE).mean() > _SOME


def check_views(cameras: list[CameraInfo]) -> Iterator[Finding]:
    """Number and sizes of the photos."""
    sizes = Counter(camera.file_size for camera in cameras)
    listed = ", ".join(f"{w} x {h} ({n})" for (w, h), n in sizes.most_common(3))
    listed += f" and {len(sizes) - 3} more sizes" if len(sizes) > 3 else ""
    yield fine(f"{len(cameras)} photos, none missing and all readable: {listed}")
    if len(cameras) < FEWEST_VIEWS:
        yield Finding(f"only {len(cameras)} photos", f"take {FEWEST_VIEWS} or more; new views will look bad with fewer")
    if wide := sum(n for (width, _), n in sizes.items() if width > _WIDE):
        yield fine(f"{wide} photos are wider than {_WIDE} pixels and train at that width unless -r 1 is given")


def of_photos(info: SceneInfo, most: int, alpha: bool = True) -> Iterator[Finding]:
    """What is wrong with the photos, of which at most `most` are decoded. alpha: whether it counts."""
    looks = _looks(info.train_cameras, most, alpha)
    if not looks:
        return
    yield from _hidden(looks)
    shown = [look for look in looks if look.seen > _SOME]
    yield from _alpha(shown)
    yield from _ranges(shown)
    yield from _bars(shown)


def hints(info: SceneInfo, smallest: tuple[int, int], white_background: bool) -> Iterator[Finding]:
    """What options may cure: images of a training's smallest size (width, height), and transparent ones on black."""
    if min(smallest) < SMALL:
        text = f"images of {smallest[0]}x{smallest[1]} pixels are too small to learn from"
        yield Finding(text, "give a larger --resolution")
    first = info.train_cameras[0]
    counts = not (getattr(first, "opaque", False) or getattr(first, "ignore_alpha", False))
    if (
        info.is_nerf_synthetic
        and not white_background
        and counts
        and first.image_path
        and _has_alpha(Path(first.image_path))
    ):
        text = "transparent parts of the images count as black"
        yield Finding(text, "with -w they count as white, as in published results of such scenes")


def _has_alpha(path: Path) -> bool:
    try:
        with open_image(path) as image:
            return image.mode in ("RGBA", "LA")
    except UNREADABLE:
        return False


def _looks(views: Sequence[Any], most: int, has_alpha: bool) -> list[Look]:
    """Looks at views in a random order, since every second photo may be of another kind; fewer of large photos."""
    order, looks, decoded = np.random.default_rng(0).permutation(len(views)), [], 0.0
    for number in order[:most]:
        try:
            look, cost = _look(views[number], has_alpha)
        except (*UNREADABLE, UserError, AttributeError):
            continue  # of a reader that reads photos from elsewhere
        looks.append(look)
        decoded += cost
        if decoded > _MOST_DECODED and len(looks) >= _FEWEST:
            break
    return looks


def _look(view: Any, has_alpha: bool) -> tuple[Look, float]:
    """A view's photo, and the pixels that were decoded for it."""
    if (image := getattr(view, "image", None)) is not None:
        pixels, sixteen, cost = _in_memory(image)
    else:
        pixels, sixteen, cost = _decoded(Path(view.image_path))
    pixels = pixels if has_alpha else pixels[..., :3]
    counts = np.ones(pixels.shape[:2], bool)
    mask = getattr(view, "mask", None)
    if mask is not None:
        counts, more = _kept(mask, pixels.shape[:2])
        cost += more
    alpha = pixels[..., 3] * 255 if pixels.shape[2] == 4 and pixels[..., 3].min() < 1 else None
    seen = counts if alpha is None else counts & (alpha >= _VISIBLE)
    colors = pixels[seen][:, :3] if seen.any() else np.zeros((1, 3))
    look = Look(
        view.image_name,
        np.quantile(colors, (_SOME, 1 - _SOME), axis=0),
        None if alpha is None else alpha.ravel(),
        float(counts.mean()),
        float(seen.mean()),
        max(len(np.unique(colors[:, channel])) for channel in range(3)),
        sixteen,
        np.array([_bar(np.rot90(pixels[..., :3], turn), np.rot90(seen, turn)) for turn in range(4)]),
    )
    return look, cost


def _bar(pixels: np.ndarray, seen: np.ndarray) -> float:
    """Height of a bar of one colour over the top of pixels (h, w, 3) in [0, 1], as a part; 0 if there is none.

    It ends with a row that has another colour over most of its width, which what stands before a background has not.
    """
    same = np.abs(pixels - np.median(pixels[0], axis=0)).max(2) <= _EQUAL
    whole = same.mean(1) > 1 - 2 * _SOME
    height = len(whole) if whole.all() else int(whole.argmin())
    beside = min(height + _ENDS, len(same) - 1)
    ends = height < len(same) and same[beside].mean() < 0.5
    return height / len(same) if ends and height and seen[:height].mean() > 0.5 else 0.0


def _decoded(path: Path) -> tuple[np.ndarray, bool, float]:
    """Some pixels (h, w, 3 or 4) of a photo in [0, 1], whether it has 16 bits, and the pixels that were decoded."""
    with open_image(path) as image:
        cost = image.width * image.height * (_JPEG if image.format == "JPEG" else 1)
        image.draft("RGB", (_PIXELS, _PIXELS))
        return *_sampled(image), cost


def _in_memory(image: Any) -> tuple[np.ndarray, bool, float]:
    if isinstance(image, Image.Image):
        return *_sampled(image), image.width * image.height
    pixels = _thinned(image.pixels.permute(1, 2, 0)).cpu().numpy()  # scene.images.store.InMemory
    return (pixels / 255.0 if pixels.dtype == np.uint8 else pixels), False, 0.0


def _sampled(image: Image.Image) -> tuple[np.ndarray, bool]:
    if image.mode.startswith("I"):
        grey = np.clip(_thinned(np.asarray(image)), 0, 65535) / 65535
        return np.repeat(grey[..., None], 3, axis=2), True
    image = in_srgb(image)
    image = image.convert("RGBA" if image.has_transparency_data else "RGB")
    return _thinned(np.asarray(image)) / 255.0, False


def _thinned(pixels: Any) -> Any:
    rows, columns = (max(1, side // _PIXELS) for side in pixels.shape[:2])
    return pixels[::rows, ::columns]


def _kept(mask: Mask, shape: tuple[int, int]) -> tuple[np.ndarray, int]:
    """Pixels (h, w) bool that a mask keeps, and the pixels that were decoded."""
    width, height = picture_size(mask.path)
    kept = mask.decode((width, height))[0].numpy() >= 128
    rows, columns = (np.arange(n) * side // n for n, side in zip(shape, (height, width), strict=True))
    return kept[rows[:, None], columns], width * height


def _names(looks: Sequence[Look]) -> str:
    return some(sorted(look.name for look in looks))


def _of(part: Sequence[Look], looks: Sequence[Look]) -> str:
    return f"{len(part)} of the {len(looks)} photos that were looked at"


def _hidden(looks: Sequence[Look]) -> Iterator[Finding]:
    """Photos of which nothing counts: masked, transparent, or both."""
    masked = [look for look in looks if look.kept <= _SOME]
    invisible = [look for look in looks if not look.is_visible]
    both = [look for look in looks if look.seen <= _SOME and look.kept > _SOME and look.is_visible]
    nothing = len({id(look) for look in (*masked, *invisible, *both)}) == len(looks)
    severity = Severity.HOPELESS if nothing else Severity.PROBLEM
    if invisible:
        highest = max(float(look.alpha.max()) for look in invisible)
        text = f"{_of(invisible, looks)} are invisible, as their alpha is at most {highest:.0f} of 255"
        text += "" if nothing else f" ({_names(invisible)})"
        yield Finding(text, "save them without alpha, or leave their alpha out by --mask_meaning none", severity)
    if masked:
        text = f"the masks of {_of(masked, looks)} leave out every pixel"
        text += "" if nothing else f" ({_names(masked)})"
        yield Finding(text, "draw what counts in white; --invert_masks is for masks of what is left out", severity)
    if both:
        text = f"masks and alpha together leave out every pixel of {_of(both, looks)} ({_names(both)})"
        yield Finding(text, "check what masks and alpha mean (--mask_meaning, --invert_masks)", severity)


def _alpha(looks: Sequence[Look]) -> Iterator[Finding]:
    """An alpha channel that is something other than the visibility of an object."""
    having = [look for look in looks if look.alpha is not None]
    if not having:
        return
    remedy = "save the photos without alpha, or leave it out by --mask_meaning none, if it is no transparency"
    alpha = np.concatenate([look.alpha for look in having])
    visible = alpha[alpha >= _VISIBLE]
    if visible.max() < _OPAQUE and len(having) == len(looks):
        yield Finding(f"no pixel of the photos is opaque: their alpha is at most {visible.max():.0f} of 255", remedy)
    elif (partly := (visible < _OPAQUE).mean()) > _PARTLY:
        yield Finding(f"{partly:.0%} of the visible pixels of {_of(having, looks)} are half transparent", remedy)


def _ranges(looks: Sequence[Look]) -> Iterator[Finding]:
    """Photos of few values: 10 or 12 bits in 16, thermal counts, 1 bit, one colour."""
    if not looks:
        return
    low, high = (pick([look.range[n] for look in looks], axis=0) for n, pick in ((0, np.min), (1, np.max)))
    flat = [look for look in looks if look.width < NARROW and (look.alpha is None or look.alpha.min() >= _OPAQUE)]
    if (high - low).max() < NARROW:
        yield _narrow(float(low.min()), float(high.max()), any(look.sixteen for look in looks))
    elif flat:
        text = f"{_of(flat, looks)} are nearly one colour ({_names(flat)})"
        yield Finding(text, "take them out of the scene, or restore them")
    elif all(look.values <= 2 and look.alpha is None for look in looks):
        text = "the photos have only two values, as masks have"
        yield Finding(text, "name the folder of the photos with -i")


def _bars(looks: Sequence[Look]) -> Iterator[Finding]:
    """Bars along the edges of most photos that are equally wide, as of a film's format in another."""
    if len(looks) < _FEWEST:
        return
    bars = np.array([look.bars for look in looks])
    widths = np.median(bars, axis=0)
    alike = (np.abs(bars - widths) <= 1.5 / _PIXELS).mean(0) >= _WITH_BARS
    places = zip(("top", "right", "bottom", "left"), widths, alike, strict=True)
    if found := [f"{width:.0%} at the {place}" for place, width, same in places if same and width >= _BAR]:
        text = f"the photos have bars of one colour, which train as a part of the scene: {', '.join(found)}"
        yield Finding(text, "give masks that are black there (--masks), or crop photos and cameras")


def _narrow(low: float, high: float, sixteen: bool) -> Finding:
    scale = 65535 if sixteen else 255
    if high <= 1 / scale or low >= 1 - 1 / scale:
        return Finding(f"the photos are all {'black' if high < 0.5 else 'white'}", "restore them, or take others")
    text = f"the photos use {high - low:.1%} of the range, from {low * scale:.0f} to {high * scale:.0f} of {scale}"
    if low < 0.5 * high:
        # A power of two for 10, 12 and 14 bits; what is brightest may not be in the sample.
        factor = 2 ** np.floor(np.log2(1 / high))
        return Finding(text, f"multiply their values by {factor:g}")
    factor = 0.9 / max(high - low, 1 / scale)
    return Finding(text, f"stretch these values over the whole range, about {factor:.3g}-fold")
