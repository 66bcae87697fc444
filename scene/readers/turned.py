"""Photos that lie on their side against their camera, turned as their EXIF orientation says.

Some programs make cameras of the upright photo and leave the file as the device wrote it. The turned copies are made
once and kept in the user's cache folder.
"""

import hashlib
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from PIL import ExifTags, Image
from tqdm.contrib.concurrent import thread_map

from scene.images.decode import decode, picture_size
from scene.images.lens import undistortion
from scene.readers.info import CameraInfo, are_exchanged
from splatting.files.folders import cache_folder, remove_temporary_files
from splatting.files.image_files import UNREADABLE, open_image
from splatting.files.plain_files import plain
from splatting.host.listing import some
from splatting.host.machine import threads
from utils.system_utils import UserError, atomic_write, mkdir_p

_FORMAT = b"sRGB"  # of the files in the cache; change it when the same input must give other files
_TURNS = {
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}  # EXIF 2.32, tag Orientation: the values that exchange the sides, and what makes such a file upright


def exchanged(camera: CameraInfo) -> bool:
    """Whether a view's photo, whose file_size is known, has the sides of its camera exchanged."""
    lens = camera.lens or camera
    return are_exchanged(camera.file_size, (lens.width, lens.height))


def turned_by_exif(cameras: Sequence[CameraInfo]) -> list[CameraInfo]:
    """The views, with upright copies of the photos whose sides are exchanged and whose EXIF orientation says so.

    A message names them. UserError for a cache that cannot be written.
    """
    turns = {n: turn for n, camera in enumerate(cameras) if exchanged(camera) and (turn := _turn(camera.image_path))}
    if not turns:
        return list(cameras)
    folder = cache_folder() / "turned"
    try:
        mkdir_p(folder)
    except UserError as error:
        raise UserError(f"{error}; turned photos are kept there; set GS_CACHE to use another folder") from error
    remove_temporary_files(folder)
    bar = {"max_workers": threads(), "unit": "photo", "leave": False}
    paths = thread_map(lambda n: _place(Path(cameras[n].image_path), folder), turns, desc="Looking up photos", **bar)
    copies = dict(zip(paths, turns, strict=True))  # one of equal photos

    def copy(path: Path) -> None:
        n = copies[path]
        _copy(Path(cameras[n].image_path), turns[n], cameras[n].file_size, path)

    thread_map(copy, copies, desc="Turning photos", **bar)
    print(
        f"{len(turns)} of {len(cameras)} photos are turned as their EXIF orientation says, since their cameras are of "
        f"upright photos: {some([cameras[n].image_name for n in turns])}; the copies are kept in {folder}, which may "
        "be deleted at any time",
        file=sys.stderr,
    )
    result = list(cameras)
    for n, path in zip(turns, paths, strict=True):
        result[n] = _upright(cameras[n], path)
    return result


def _upright(camera: CameraInfo, path: Path) -> CameraInfo:
    size = camera.file_size[::-1]
    # The reader has planned the undistortion for a photo of the file's size.
    pinhole = undistortion(camera.lens, *size).pinhole._asdict() if camera.lens else {}
    return replace(camera, **pinhole, image_path=path, file_size=size, lying=Path(camera.image_path))


def _turn(photo: Path) -> int | None:
    """The EXIF orientation of a readable photo, if it exchanges the sides. Pillow itself turns TIFF files."""
    try:
        with open_image(photo) as image:
            orientation = None if image.format == "TIFF" else image.getexif().get(ExifTags.Base.Orientation)
    except UNREADABLE:  # of damaged EXIF data
        return None
    return orientation if orientation in _TURNS else None


def _place(photo: Path, folder: Path) -> Path:
    digest = hashlib.blake2b(plain(photo).read_bytes(), digest_size=20, person=_FORMAT)
    return folder / f"{digest.hexdigest()}.png"


def _copy(photo: Path, turn: int, size: tuple[int, int], path: Path) -> None:
    try:
        if picture_size(path) == size[::-1]:
            return
    except UserError:
        pass  # not made yet, or cut short
    exif = _without_turn(photo)
    pixels = decode(photo, size).permute(1, 2, 0).numpy()
    with atomic_write(path, every_rank=True) as temporary:
        Image.fromarray(pixels).transpose(_TURNS[turn]).save(temporary, compress_level=1, exif=exif)


def _without_turn(photo: Path) -> bytes:
    """The EXIF data of a photo, of the lens for instance, without its orientation; none if they are damaged."""
    with open_image(photo) as image:
        exif = image.getexif()
    del exif[ExifTags.Base.Orientation]
    try:
        return exif.tobytes()
    except (*UNREADABLE, AttributeError):
        return b""
