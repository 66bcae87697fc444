"""Photos as COLMAP should get them: upright, readable, with their masks."""

import os
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from PIL import Image, ImageOps
from tqdm import tqdm

from conversion.layout import Layout, picture_names
from scene.pictures.decode import picture_size
from utils.files.image_files import UNREADABLE
from utils.host.threads import threads
from utils.system_utils import UserError

JPEG_QUALITY = 95
_ORIENTATION = 0x0112  # EXIF tag; 1 or absent: upright
_LYING = (5, 6, 7, 8)  # of its values: width and height change places
_MOST_NAMED = 20


def prepare_photos(layout: Layout, names: Sequence[str], masks: Path | None) -> None:
    """Fill `layout.photos`, and `layout.masks` where a folder of masks is given.

    A photo is linked (copied where links can't be made), unless its EXIF orientation turns it or COLMAP can't read its
    format: then it is written anew, the orientation baked into the pixels and the other EXIF data kept. Masks: see
    `_prepare_mask`. They were checked (`check_photos`); UserError for those whose pixels turn out to be broken.
    """
    with_mask = find_masks(names, masks) if masks else {}

    def prepare(name: str) -> None:
        prepared = _prepare_photo(layout.input / name, layout.photos / name)
        if masks:
            mask = layout.masks / prepared.relative_to(layout.photos)
            _prepare_mask(with_mask.get(name), mask.with_name(f"{mask.name}.png"), prepared)

    _in_threads(prepare, names, "Preparing photos")


def check_photos(layout: Layout, names: Sequence[str], masks: Path | None) -> None:
    """UserError that names all photos and masks that are broken or do not fit; decodes none that is whole."""
    with_mask = find_masks(names, masks) if masks else {}

    def check(name: str) -> None:
        size = _upright_size(layout.input / name)
        if name in with_mask:
            _check_mask(with_mask[name], name, size)

    _in_threads(check, names, "Checking photos")


def find_masks(names: Sequence[str], folder: Path) -> dict[str, Path]:
    """Masks by name of photo: `<name>.png` as COLMAP has them, or the same name, or with the suffix .png."""
    found = {}
    for name in names:
        candidates = (folder / f"{name}.png", folder / name, (folder / name).with_suffix(".png"))
        mask = next((path for path in candidates if path.is_file()), None)
        if mask:
            found[name] = mask
    if not found:
        raise UserError(
            f"none of {len(names)} photos has a mask in {folder}; looked for names like {names[0]}.png and "
            f"{Path(names[0]).with_suffix('.png')}"
        )
    return found


def sizes(layout: Layout) -> dict[tuple[int, int], list[str]]:
    """Names of the prepared photos by size (width, height), both in order."""
    groups: dict[tuple[int, int], list[str]] = {}
    for name in picture_names(layout.photos):
        groups.setdefault(picture_size(layout.photos / name), []).append(name)
    return groups


def resize_images(layout: Layout, factor: int) -> None:
    """Fill `images_<factor>` from `images`: sides divided by the factor, rounded; Pillow's bicubic filter."""

    def resize(name: str) -> None:
        with Image.open(layout.images / name) as image:
            size = tuple(max(1, round(side / factor)) for side in image.size)
            _save(image.resize(size, Image.Resampling.BICUBIC), layout.resized(factor) / name, image)

    _in_threads(resize, picture_names(layout.images), f"Resizing to 1/{factor}")


def _prepare_photo(source: Path, target: Path) -> Path:
    """Path of the prepared photo: `target`, with .png behind it where the format had to change."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        with Image.open(source) as image:
            webp = image.format == "WEBP"
            if image.getexif().get(_ORIENTATION, 1) in (0, 1) and not webp:
                _link(source, target)
                return target
            upright = ImageOps.exif_transpose(image)
            target = target.with_name(f"{target.name}.png") if webp else target
            _save(upright, target, image, exif=upright.getexif())
            return target
    except UNREADABLE as error:
        raise UserError(f"cannot turn the photo {source} upright ({error}); replace it or take it out") from error


def _upright_size(photo: Path) -> tuple[int, int]:
    width, height = picture_size(photo)  # a UserError for what is cut short or no picture
    try:
        with Image.open(photo) as image:
            lies = image.getexif().get(_ORIENTATION, 1) in _LYING
    except UNREADABLE as error:
        raise UserError(f"cannot read the EXIF data of {photo} ({error}); replace it or take it out") from error
    return (height, width) if lies else (width, height)


def _check_mask(mask: Path, name: str, size: tuple[int, int]) -> None:
    found = picture_size(mask)
    if found != size:
        raise UserError(
            f"the mask {mask} has {found[0]} x {found[1]} pixels, but its photo {name} has {size[0]} x {size[1]} when "
            "it is upright; make masks from the photos as they are displayed"
        )


def _prepare_mask(source: Path | None, target: Path, photo: Path) -> None:
    """Write a mask as 8-bit grey PNG; black (0) is ignored.

    Without a source it is white: COLMAP leaves photos out that have none while others have.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    if source is None:
        Image.new("L", picture_size(photo), 255).save(target)
        return
    try:
        with Image.open(source) as image:
            mask = image.convert("L")
    except UNREADABLE as error:
        raise UserError(f"cannot read the mask {source} ({error}); replace it or take it out") from error
    mask.save(target)


def _save(image: Image.Image, target: Path, like: Image.Image, **options: object) -> None:
    """Save in the format of the picture that it was made from, colour profile kept."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if profile := like.info.get("icc_profile"):
        options["icc_profile"] = profile
    if like.format in ("JPEG", "MPO"):
        image.save(target, "JPEG", quality=JPEG_QUALITY, subsampling=0, **options)
    else:
        image.save(target, "PNG" if like.format == "WEBP" else like.format, **options)


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def _in_threads(work: Callable[[str], None], names: Sequence[str], title: str) -> None:
    """Do the work for all names. UserError where it ended in any, with all of them."""

    def attempt(name: str) -> UserError | None:
        try:
            work(name)
        except UserError as error:
            return error
        return None

    with ThreadPoolExecutor(threads()) as pool, tqdm(total=len(names), desc=title, dynamic_ncols=True) as bar:
        try:
            faults = []
            for fault in pool.map(attempt, names):
                bar.update()
                if fault:
                    faults.append(fault)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    if len(faults) == 1:
        raise faults[0]
    if faults:
        # Of each what is wrong, without the remedy, which is the same for all.
        listed = "; ".join(str(fault).partition("; ")[0] for fault in faults[:_MOST_NAMED])
        more = f"; and {len(faults) - _MOST_NAMED} more" if len(faults) > _MOST_NAMED else ""
        raise UserError(
            f"{len(faults)} of {len(names)} pictures can't be used: {listed}{more}; replace them or take them out"
        )
