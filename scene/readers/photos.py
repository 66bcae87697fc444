"""Photos made ready for training: checked, upright, and of a lens that the rasterizer knows.

Some programs make cameras of the upright photo and leave the file as the device wrote it. Such photos, and those whose
lens the rasterizer does not know, are copied once into the user's cache folder. The key of an undistorted file covers
the bytes of photo and mask, the lens, the options and the version of pycolmap. So an edited photo is undistorted again,
and a copied or moved scene is not.
"""

import hashlib
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from diff_gaussian_rasterization.lens import MODELS, lens_of
from PIL import ExifTags, Image
from PIL.PngImagePlugin import PngInfo

from groundwork.files.color_tags import mark_srgb
from groundwork.files.folders import cache_folder, remove_temporary_files
from groundwork.files.image_files import UNREADABLE, open_image
from groundwork.files.plain_files import plain_path
from groundwork.host.listing import some
from groundwork.host.progress import in_threads
from scene.images.decode import decode, picture_size, picture_sizes
from scene.images.lens import (
    PANORAMA,
    Lens,
    Pinhole,
    Undistortion,
    import_pycolmap,
    pinhole_of,
    undistortion,
    visible_pixels,
)
from scene.images.masks import TRANSPARENT, Mask
from scene.readers.info import CameraInfo, are_exchanged, describe_exchanged_sides
from utils.system_utils import UserError, atomic_write, mkdir_p

FARTHEST = 1e12  # from the origin, beyond which lie damaged files; there a double has steps of 1e-4
# Of the files in the cache; change it when the same input must give other files.
_UPRIGHT_FORMAT, _UNDISTORTED_FORMAT = b"sRGB", "3"
_HAS_MASK = "mask"  # text in an undistorted file, yes or no, so that a deleted mask is noticed
_SQUARE = 0.01  # difference of focal lengths of square pixels
_TURNS = {
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}  # EXIF 2.32, tag Orientation: the values that exchange the sides, and what makes such a file upright

Job = TypeVar("Job")
Result = TypeVar("Result")


def camera_info(
    uid: int,
    name: str,
    path: Path,
    lens: Lens,
    R: np.ndarray,
    T: np.ndarray,
    mask: Mask | None = None,
    ignore_alpha: bool = False,
    native: bool = False,
) -> CameraInfo:
    """The view of a photo with any lens. The photo is only read if it has to be undistorted.

    native: take photos as they are, through their lenses, where the rasterizer knows the camera model.

    UserError names a view that cannot be used: its lens, its pose, or the photo.
    """
    pinhole, through = pinhole_of(lens, name), None
    distorts = pinhole is None
    if distorts and native and lens.model in MODELS:
        through, distorts = lens_of(lens.model, lens.params), False
        pinhole = Pinhole(*through.focal, *(place + 0.5 for place in through.center), lens.width, lens.height)
    elif distorts and lens.model == PANORAMA:
        raise UserError(
            f"the photo {name} is a panorama, which no pinhole image can show; train on it with --lenses native"
        )
    elif distorts:
        pinhole = undistortion(lens, *picture_size(path)).pinhole
    camera = CameraInfo(
        uid=uid,
        R=R,
        T=T,
        **pinhole._asdict(),
        image_path=path,
        image_name=name,
        lens=lens if distorts else None,
        native=through,
        mask=mask,
        ignore_alpha=ignore_alpha,
    )
    if max(np.abs(camera.T).max(), np.abs(camera.center).max()) > FARTHEST:
        raise UserError(
            f"the camera of {name} is more than {FARTHEST:g} from the origin; take the photo out of the scene, or "
            "move the scene to its origin"
        )
    return camera


def to_pinholes(cameras: Sequence[CameraInfo], opaque: bool = False) -> list[CameraInfo]:
    """Make all views pinholes or native lenses, with sizes of photos: other photos are undistorted.

    opaque: drop the photos' alpha, before undistortion mixes it with colours.

    Photos that lie on their side against their camera are turned if their EXIF orientation says so. A message says
    which photos have another shape than their camera. UserError for photos that cannot be read or stay on their side,
    and for a mask that cannot be used.
    """
    sizes = picture_sizes([camera.image_path for camera in cameras])
    cameras = [replace(camera, file_size=size, opaque=opaque) for camera, size in zip(cameras, sizes, strict=True)]
    cameras = _make_upright(cameras)
    _check_shapes(cameras)
    for camera in cameras:
        if camera.mask is not None:
            _check_mask(camera.mask.path, camera.file_size, camera.lying)
    if distorted := [index for index, camera in enumerate(cameras) if camera.lens]:
        for index, camera in zip(distorted, undistort([cameras[index] for index in distorted]), strict=True):
            cameras[index] = camera
    return cameras


def _check_mask(mask: Path, size: tuple[int, int], lying: Path | None = None) -> None:
    """Raise a UserError if a mask has another aspect ratio than its photo of a size (width, height).

    lying: the photo's own file if it was turned upright, else None.
    """
    mask_size = picture_size(mask)
    # A smaller mask has whole pixels, too: half of 269 is 134 or 135.
    if abs(size[0] * mask_size[1] - size[1] * mask_size[0]) > max(*size, *mask_size):
        upright = " when upright" if lying else ""
        raise UserError(
            f"the mask {mask} is {mask_size[0]} x {mask_size[1]} pixels and its photo {size[0]} x {size[1]}{upright}; "
            f"make masks of the same shape as the {'upright ' if lying else ''}photos"
        )


def _check_shapes(cameras: Sequence[CameraInfo]) -> None:
    """UserError if photos would be stretched from upright to lying, or the other way round; a message if otherwise."""
    if lying := [camera for camera in cameras if _is_exchanged(camera)]:
        lens, names = lying[0].lens or lying[0], [camera.image_name for camera in lying]
        said = describe_exchanged_sides(names, len(cameras), lying[0].file_size, (lens.width, lens.height))
        raise UserError("; ".join(said))
    shapes = [(camera, camera.file_size, camera.lens or camera) for camera in cameras]
    others = [
        (camera.image_name, f"{size[0]} x {size[1]}, camera {shape.width} x {shape.height}")
        for camera, size, shape in shapes
        if abs(size[0] * shape.height / shape.width - size[1]) > 1
    ]
    if others:
        (name, sizes), count = others[0], f"{len(others)} of {len(cameras)} photos"
        fault = "do not have the aspect ratio of their camera and will be stretched"
        square = any(camera.image_name == name and abs(camera.fx / camera.fy - 1) < _SQUARE for camera in cameras)
        remedy = "; its pixels are square (fx = fy), so the photos are rather padded or cropped: use those that the "
        remedy += "cameras were made for, or give width, height, cx and cy of these"
        print(f"{count} {fault}; the first is {name} ({sizes}){remedy * square}", file=sys.stderr)


def _make_cache_subfolder(folder: Path, kind: str) -> Path:
    """Make a folder of the cache. UserError if that fails."""
    try:
        mkdir_p(folder)
    except UserError as error:
        raise UserError(f"{error}; {kind} photos are kept there; set GS_CACHE to use another folder") from error
    return folder


def _run_in_threads(work: Callable[[Job], Result], jobs: Iterable[Job], title: str) -> list[Result]:
    # pycolmap, Pillow and hashlib release Python's lock while they work.
    return in_threads(work, jobs, desc=title, unit="photo", leave=False)


def _is_exchanged(camera: CameraInfo) -> bool:
    """Tell whether a photo, whose file_size is known, has its camera's width and height exchanged."""
    lens = camera.lens or camera
    return are_exchanged(camera.file_size, (lens.width, lens.height))


def _make_upright(cameras: Sequence[CameraInfo]) -> list[CameraInfo]:
    """The views, with upright copies of the photos whose sides are exchanged and whose EXIF orientation says so.

    A message names them. UserError for a cache that cannot be written.
    """
    cameras = list(cameras)
    turns = {n: turn for n, one in enumerate(cameras) if _is_exchanged(one) and (turn := _read_turn(one.image_path))}
    if not turns:
        return cameras
    folder = _make_cache_subfolder(cache_folder() / "turned", "turned")
    remove_temporary_files(folder)
    photos = [Path(cameras[n].image_path) for n in turns]
    paths = _run_in_threads(lambda photo: _name_upright_copy(photo, folder), photos, "Looking up photos")
    copies = dict(zip(paths, turns, strict=True))  # one of equal photos
    _run_in_threads(
        lambda path: _turn_photo(cameras[copies[path]], turns[copies[path]], path), copies, "Turning photos"
    )
    print(
        f"{len(turns)} of {len(cameras)} photos are turned as their EXIF orientation says, since their cameras are of "
        f"upright photos: {some([cameras[n].image_name for n in turns])}; the copies are kept in {folder}, which may "
        "be deleted at any time",
        file=sys.stderr,
    )
    for n, path in zip(turns, paths, strict=True):
        camera, size = cameras[n], cameras[n].file_size[::-1]
        # The reader has planned the undistortion for a photo of the file's size.
        pinhole = undistortion(camera.lens, *size).pinhole._asdict() if camera.lens else {}
        cameras[n] = replace(camera, **pinhole, image_path=path, file_size=size, lying=Path(camera.image_path))
    return cameras


def _read_turn(photo: Path) -> int | None:
    """The EXIF orientation of a readable photo, if it exchanges the sides. Pillow itself turns TIFF files."""
    try:
        with open_image(photo) as image:
            orientation = None if image.format == "TIFF" else image.getexif().get(ExifTags.Base.Orientation)
    except UNREADABLE:  # of damaged EXIF data
        return None
    return orientation if orientation in _TURNS else None


def _name_upright_copy(photo: Path, folder: Path) -> Path:
    digest = hashlib.blake2b(plain_path(photo).read_bytes(), digest_size=20, person=_UPRIGHT_FORMAT)
    return folder / f"{digest.hexdigest()}.png"


def _turn_photo(camera: CameraInfo, turn: int, path: Path) -> None:
    """Write the upright copy of a lying photo to `path`, unless it is there. turn: its EXIF orientation."""
    photo, size = Path(camera.image_path), camera.file_size
    try:
        if picture_size(path) == size[::-1]:
            return
    except UserError:
        pass  # not made yet, or cut short
    exif = _read_exif_without_turn(photo)
    pixels = decode(photo, size).permute(1, 2, 0).numpy()
    with atomic_write(path, every_rank=True) as temporary:
        Image.fromarray(pixels).transpose(_TURNS[turn]).save(temporary, compress_level=1, exif=exif)


def _read_exif_without_turn(photo: Path) -> bytes:
    """The EXIF data of a photo, of the lens for instance, without its orientation; none if they are damaged."""
    with open_image(photo) as image:
        exif = image.getexif()
    del exif[ExifTags.Base.Orientation]
    try:
        mark_srgb(exif)
        return exif.tobytes()
    except (*UNREADABLE, AttributeError):
        return b""


def undistorted_folder() -> Path:
    """Folder of the undistorted photos in the user's cache."""
    return cache_folder() / "undistorted"


def undistort(photos: Sequence[CameraInfo]) -> list[CameraInfo]:
    """The views with their undistorted photos, made now or found in the cache, with a progress bar on stderr.

    Bilinear, as in COLMAP. Alpha is undistorted, too, and weights the colours. UserError for a broken photo or a cache
    that cannot be written.
    """
    folder = _make_cache_subfolder(undistorted_folder(), "undistorted")
    _say_which_are_cut(photos)
    version = import_pycolmap().__version__
    keys = _run_in_threads(lambda photo: _hash_photo(photo, version), photos, "Looking up undistorted photos")
    paths = [folder / key[:2] / f"{key}.png" for key in keys]
    missing = {path: photo for path, photo in zip(paths, photos, strict=True) if not _is_cached(path)}
    if missing:
        remove_temporary_files(folder)
        _run_in_threads(lambda item: _write_undistorted(item[1], item[0]), missing.items(), "Undistorting photos")
        size = sum(path.stat().st_size for path in missing)
        print(
            f"{len(missing)} undistorted photos ({size / 1e6:.0f} MB) are kept in {folder}; it may be deleted at any "
            "time; set GS_CACHE to use another folder",
            file=sys.stderr,
        )
    return [_refer_to_result(photo, path) for photo, path in zip(photos, paths, strict=True)]


def _say_which_are_cut(photos: Sequence[CameraInfo]) -> None:
    """Say how many photos of wide lenses are cut to a narrower field of view."""
    cut = [photo for photo in photos if undistortion(photo.lens, *photo.file_size).widest is not None]
    if cut:
        plan = undistortion(cut[0].lens, *cut[0].file_size)
        name = Path(cut[0].image_path).name
        print(
            f"{len(cut)} photos, the first is {name}, have a field of view that is too wide for a pinhole image; "
            f"their inner {2 * plan.widest:.0f} degrees are used",
            file=sys.stderr,
        )


def _hash_photo(photo: CameraInfo, version: str) -> str:
    """Return the hash, hexadecimal, of all that an undistorted photo depends on. version: of the code that makes it."""
    digest = hashlib.blake2b(digest_size=20)
    mask = photo.mask and (photo.mask.inverted, photo.mask.meaning)
    digest.update(
        repr((_UNDISTORTED_FORMAT, version, tuple(photo.lens), photo.file_size, mask, photo.ignore_alpha)).encode()
    )
    if photo.opaque:
        digest.update(b"opaque")
    if photo.mask and photo.mask.circle:
        digest.update(repr((photo.mask.circle, photo.mask.drawn)).encode())
    for path in (photo.image_path, photo.mask.path if photo.mask else None):
        if path is not None:
            try:
                content = plain_path(path).read_bytes()
            except OSError as error:
                raise UserError(f"cannot read {path} ({error.strerror}); fix its permissions") from error
            digest.update(len(content).to_bytes(8, "little") + content)
    return digest.hexdigest()


def _is_cached(path: Path) -> bool:
    """Tell whether the undistorted photo is in the cache and complete, with its mask if it was made with one."""
    if not path.is_file():
        return False
    try:
        picture_size(path)
        with open_image(path) as image:
            has_mask = image.info.get(_HAS_MASK)
        if has_mask == "yes":
            picture_size(_name_mask(path))
    except UserError:
        return False
    return has_mask in ("yes", "no")


def _name_mask(path: Path) -> Path:
    return path.with_suffix(".mask.png")


def _refer_to_result(photo: CameraInfo, path: Path) -> CameraInfo:
    mask = Mask(_name_mask(path)) if _name_mask(path).is_file() else None
    size = photo.width, photo.height
    return replace(photo, image_path=path, file_size=size, mask=mask, ignore_alpha=False, opaque=False, lens=None)


def _write_undistorted(photo: CameraInfo, path: Path) -> None:
    """Write a photo without distortion to `path`, and the mask of its pixels that count if not all do."""
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
    visible = visible_pixels(photo.lens, *photo.file_size)
    if not counts.all():
        # Interpolation mixes neighbours: a pixel counts only if all that contribute to it count.
        visible = visible & (_warp(np.where(counts, 255, 0).astype(np.uint8), plan) == 255)
    mask_path = _name_mask(path)
    has_mask = not visible.all()
    if has_mask:
        with atomic_write(mask_path, every_rank=True) as temporary:
            Image.fromarray(np.where(visible, 255, 0).astype(np.uint8)).save(temporary)
    text = PngInfo()
    text.add_text(_HAS_MASK, "yes" if has_mask else "no")
    # Written after the mask, so that a file never lacks its mask.
    with atomic_write(path, every_rank=True) as temporary:
        Image.fromarray(_warp_picture(pixels, plan)).save(temporary, compress_level=1, pnginfo=text)


def _warp_picture(pixels: np.ndarray, plan: Undistortion) -> np.ndarray:
    """Undistort pixels (H, W, 3 or 4) uint8; colours are weighed by alpha."""
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
