"""Photos of distorting lenses as pinhole images, made once and kept in the user's cache folder.

The key of a kept file covers the bytes of photo and mask, the lens, the options and the version of pycolmap. So an
edited photo is undistorted again, and a copied or moved scene is not.
"""

import hashlib
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from tqdm.contrib.concurrent import thread_map

from scene.images.decode import decode, picture_size
from scene.images.lens import Undistortion, import_pycolmap, shown_pixels, undistortion
from scene.images.masks import TRANSPARENT, Mask
from scene.readers.info import CameraInfo
from splatting.files.folders import cache_folder, remove_temporary_files
from splatting.files.image_files import open_image
from splatting.files.plain_files import plain
from splatting.host.machine import threads
from utils.system_utils import UserError, atomic_write, mkdir_p

_FORMAT = "3"  # of the files in the cache; raise it when the same input must give other files

_HAS_MASK = "mask"  # text in an undistorted file, yes or no, so that a deleted mask is noticed

Job = TypeVar("Job")
Result = TypeVar("Result")


def undistorted_folder() -> Path:
    """Folder of the undistorted photos in the user's cache."""
    return cache_folder() / "undistorted"


def undistort(photos: Sequence[CameraInfo]) -> list[CameraInfo]:
    """The views with their undistorted photos, made now or found in the cache, with a progress bar on stderr.

    Bilinear, as in COLMAP. Alpha is undistorted, too, and weights the colours. UserError for a broken photo or a cache
    that cannot be written.
    """
    folder = undistorted_folder()
    try:
        mkdir_p(folder)
    except UserError as error:
        raise UserError(f"{error}; undistorted photos are kept there; set GS_CACHE to use another folder") from error
    _say_which_are_cut(photos)
    version = import_pycolmap().__version__
    keys = _in_threads(lambda photo: _key(photo, version), photos, "Looking up undistorted photos")
    paths = [folder / key[:2] / f"{key}.png" for key in keys]
    missing = {path: photo for path, photo in zip(paths, photos, strict=True) if not _kept(path)}
    if missing:
        remove_temporary_files(folder)
        _in_threads(lambda item: _make(item[1], item[0]), list(missing.items()), "Undistorting photos")
        size = sum(path.stat().st_size for path in missing)
        print(
            f"{len(missing)} undistorted photos ({size / 1e6:.0f} MB) are kept in {folder}; it may be deleted at any "
            "time; set GS_CACHE to use another folder",
            file=sys.stderr,
        )
    return [_result(photo, path) for photo, path in zip(photos, paths, strict=True)]


def _say_which_are_cut(photos: Sequence[CameraInfo]) -> None:
    cut = [photo for photo in photos if undistortion(photo.lens, *photo.file_size).widest is not None]
    if cut:
        plan = undistortion(cut[0].lens, *cut[0].file_size)
        name = Path(cut[0].image_path).name
        print(
            f"{len(cut)} photos, the first is {name}, have a field of view that is too wide for a pinhole image; "
            f"their inner {2 * plan.widest:.0f} degrees are used",
            file=sys.stderr,
        )


def _in_threads(work: Callable[[Job], Result], jobs: Sequence[Job], title: str) -> list[Result]:
    # pycolmap, Pillow and hashlib release Python's lock while they work.
    return thread_map(work, jobs, max_workers=threads(), desc=title, unit="photo", leave=False)


def _key(photo: CameraInfo, version: str) -> str:
    digest = hashlib.blake2b(digest_size=20)
    mask = photo.mask and (photo.mask.inverted, photo.mask.meaning)
    digest.update(repr((_FORMAT, version, tuple(photo.lens), photo.file_size, mask, photo.ignore_alpha)).encode())
    if photo.opaque:
        digest.update(b"opaque")
    if photo.mask and photo.mask.circle:
        digest.update(repr((photo.mask.circle, photo.mask.drawn)).encode())
    for path in (photo.image_path, photo.mask.path if photo.mask else None):
        if path is not None:
            try:
                content = plain(path).read_bytes()
            except OSError as error:
                raise UserError(f"cannot read {path} ({error.strerror}); fix its permissions") from error
            digest.update(len(content).to_bytes(8, "little") + content)
    return digest.hexdigest()


def _kept(path: Path) -> bool:
    """Whether the undistorted photo is in the cache and complete, with its mask if it was made with one."""
    if not path.is_file():
        return False
    try:
        picture_size(path)
        with open_image(path) as image:
            has_mask = image.info.get(_HAS_MASK)
        if has_mask == "yes":
            picture_size(_mask_path(path))
    except UserError:
        return False
    return has_mask in ("yes", "no")


def _mask_path(path: Path) -> Path:
    return path.with_suffix(".mask.png")


def _result(photo: CameraInfo, path: Path) -> CameraInfo:
    mask = Mask(_mask_path(path)) if _mask_path(path).is_file() else None
    size = photo.width, photo.height
    return replace(photo, image_path=path, file_size=size, mask=mask, ignore_alpha=False, opaque=False, lens=None)


def _make(photo: CameraInfo, path: Path) -> None:
    plan = undistortion(photo.lens, *photo.file_size)
    pixels = decode(photo.image_path, photo.file_size, photo.opaque).permute(1, 2, 0).numpy()
    counts = np.ones(pixels.shape[:2], bool)
    if photo.ignore_alpha and pixels.shape[2] == 4:
        counts &= pixels[..., 3] == 255
        pixels = pixels[..., :3]
    if photo.mask is not None:
        mask = photo.mask.decode(photo.file_size)[0].numpy()
        if photo.mask.meaning == TRANSPARENT:
            own = pixels[..., 3:] if pixels.shape[2] == 4 else np.full_like(mask[..., None], 255)
            pixels = np.dstack([pixels[..., :3], np.round(own / 255.0 * mask[..., None]).astype(np.uint8)])
        else:
            counts &= mask == 255
    shown = shown_pixels(photo.lens, *photo.file_size)
    if not counts.all():
        # Interpolation mixes neighbours: a pixel counts only if all that contribute to it count.
        shown = shown & (_warp(np.where(counts, 255, 0).astype(np.uint8), plan) == 255)
    mask_path = _mask_path(path)
    has_mask = not shown.all()
    if has_mask:
        with atomic_write(mask_path, every_rank=True) as temporary:
            Image.fromarray(np.where(shown, 255, 0).astype(np.uint8)).save(temporary)
    text = PngInfo()
    text.add_text(_HAS_MASK, "yes" if has_mask else "no")
    # Written after the mask, so that a file never lacks its mask.
    with atomic_write(path, every_rank=True) as temporary:
        Image.fromarray(_warp_picture(pixels, plan)).save(temporary, compress_level=1, pnginfo=text)


def _warp_picture(pixels: np.ndarray, plan: Undistortion) -> np.ndarray:
    if pixels.shape[2] == 3:
        return _warp(pixels, plan)
    alpha = _warp(pixels[..., 3], plan)
    weighed = _warp(np.round(pixels[..., :3] * (pixels[..., 3:] / 255.0)).astype(np.uint8), plan)
    straight = np.round(weighed * (255.0 / np.maximum(alpha, 1)[..., None])).clip(0, 255).astype(np.uint8)
    return np.dstack([straight, alpha])


def _warp(pixels: np.ndarray, plan: Undistortion) -> np.ndarray:
    pycolmap = import_pycolmap()
    bitmap = pycolmap.Bitmap.from_array(np.ascontiguousarray(pixels))
    return pycolmap.undistort_image(plan.options, bitmap, plan.camera)[0].to_array()
