"""Photos for COLMAP: upright, in a readable format, with their masks."""

import contextlib
import os
import re
import shutil
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path

from PIL import Image, ImageOps

from applications.convert.layout import Layout, image_names
from groundwork.files.color_profiles import has_other_colors, to_srgb
from groundwork.files.color_tags import mark_srgb
from groundwork.files.image_files import SUFFIXES, UNREADABLE, open_image
from groundwork.finding import Finding
from groundwork.host.progress import in_threads
from scene.checks.photos import Photo, check_shared, looks_at
from scene.images.decode import picture_size
from scene.images.find import SideFiles
from scene.images.masks import Mask, mask_names
from utils.system_utils import UserError

JPEG_QUALITY = 95
_ORIENTATION = 0x0112  # EXIF tag; 1 or absent: upright
_LYING = (5, 6, 7, 8)  # values of the tag that exchange width and height
_MOST_NAMED = 20
# Of Google's Photo Sphere XMP: widths that differ are those of a part.
_PANORAMA = re.compile(rb"ProjectionType\W{1,6}equirectangular", re.IGNORECASE)
_PANORAMA_WIDTHS = re.compile(rb"(?:FullPano|CroppedAreaImage)WidthPixels\W{1,6}(\d+)")
_COMPARED = 48  # photos, by their pixels
_OR_WITHOUT = "or pass --skip_unreadable to convert.py to go on without photos that cannot be read"
# Formats that COLMAP reads, or in which photos of other formats are written for it: HEIC and AVIF lose little as JPEG.
_WRITTEN = {"JPEG": "JPEG", "MPO": "JPEG", "PNG": "PNG", "TIFF": "TIFF", "BMP": "BMP", "HEIF": "JPEG", "AVIF": "JPEG"}
_ENDS = {"JPEG": ".jpg", "PNG": ".png", "TIFF": ".tif", "BMP": ".bmp"}
_LINKED = ("JPEG", "MPO", "PNG", "TIFF", "BMP")


def prepare_images(layout: Layout, names: Sequence[str], masks: Path | None) -> None:
    """Fill `layout.prepared`, and `layout.masks` if a folder of masks is given.

    A photo is linked, or copied if links are impossible. A photo that its EXIF orientation turns, whose format
    COLMAP cannot read, or whose colours are not sRGB, which COLMAP takes those of points for, is rewritten, with
    upright pixels in sRGB and the other EXIF data kept. A name without the suffix of its format gets one appended.
    Masks: see `_prepare_mask`.
    `check_images` must have passed before; UserError for files whose pixels turn out to be broken.
    """
    with_mask = find_masks(names, masks, layout.input) if masks else {}
    taken = {layout.prepared / name for name in names}

    def prepare(name: str) -> None:
        prepared = _prepare_image(layout.input / name, layout.prepared / name, taken)
        if masks:
            mask = layout.masks / prepared.relative_to(layout.prepared)
            _prepare_mask(with_mask.get(name), mask.with_name(f"{mask.name}.png"), prepared)

    _do_for_all(prepare, names, "Preparing photos")


def name_prepared(layout: Layout, names: Sequence[str]) -> dict[str, str]:
    """The names that `prepare_images` gives photos, by their own; a photo that cannot be read keeps its own."""
    found, taken = {}, {layout.prepared / name for name in names}
    for name in names:
        found[name] = name
        with contextlib.suppress(*UNREADABLE), open_image(layout.input / name) as image:
            target = _prepared_path(image, layout.prepared / name, taken)
            found[name] = target.relative_to(layout.prepared).as_posix()
    return found


def check_images(layout: Layout, names: Sequence[str], masks: Path | None) -> None:
    """Raise a UserError that names every photo and mask that is broken or does not fit; warn of shared pixels."""
    with_mask = find_masks(names, masks, layout.input) if masks else {}

    def check(name: str) -> None:
        try:
            size = read_upright_size(layout.input / name)
        except UserError as error:
            raise UserError(f"{error}, {_OR_WITHOUT}") from error
        if name in with_mask:
            _check_mask(with_mask[name], name, size)

    _do_for_all(check, names, "Checking photos", f"replace or remove them, {_OR_WITHOUT}")
    for found in find_shared_pixels(layout.input, names, with_mask):
        print(f"warning: {found}", file=sys.stderr)


def find_panoramas(folder: Path, names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Find the photos that are twice as wide as high, and those of them that are whole panoramas by their XMP data."""
    wide, marked = [], []
    for name in names:
        with contextlib.suppress(*UNREADABLE), open_image(folder / name) as image:
            if image.width == 2 * image.height:
                wide.append(name)
                text = image.info.get("xmp", image.info.get("XML:com.adobe.xmp", b""))
                text = text.encode() if isinstance(text, str) else text
                if _PANORAMA.search(text) and len({*_PANORAMA_WIDTHS.findall(text)}) < 2:
                    marked.append(name)
    return wide, marked


def find_shared_pixels(
    folder: Path, names: Sequence[str], masks: Mapping[str, Path], place: Path | None = None
) -> list[Finding]:
    """Find pixels that nearly all photos in a folder share.

    masks: files by a photo's name.
    place: the user's folder of these photos, if that is another.
    """
    given = {name: Mask(path) for name, path in masks.items() if path.is_file()}
    photos = [Photo(name, folder / name, given.get(name)) for name in names]
    return [*check_shared(looks_at(photos, _COMPARED), place or folder)]


def find_masks(names: Sequence[str], folder: Path, photos: Path) -> dict[str, Path]:
    """Return the masks by name of photo, found in a folder as `scene.images.masks.find_masks` finds them.

    photos: folder of the photos. UserError if no photo has a mask.
    """
    files = SideFiles(folder, names, [photos / name for name in names], photos)
    masks = {name: files.find(place, mask_names) for place, name in enumerate(names)}
    found = {name: mask for name, mask in masks.items() if mask}
    if not found:
        raise UserError(
            f"none of {len(names)} photos has a mask in {folder}; looked for names like {names[0]}.png and "
            f"{Path(names[0]).with_suffix('.png')}, which are no photos; name the folder of the masks"
        )
    return found


def group_by_size(layout: Layout) -> dict[tuple[int, int], list[str]]:
    """Return the names of the prepared photos by size (width, height), in order."""
    groups: dict[tuple[int, int], list[str]] = {}
    for name in image_names(layout.prepared):
        groups.setdefault(picture_size(layout.prepared / name), []).append(name)
    return groups


def resize_images(layout: Layout, factor: int) -> None:
    """Fill `images_<factor>` from `images` by Pillow's bicubic filter; sides are divided by the factor and rounded."""

    def resize(name: str) -> None:
        with open_image(layout.images / name) as image:
            size = tuple(max(1, round(side / factor)) for side in image.size)
            _save_srgb(image.resize(size, Image.Resampling.BICUBIC), layout.resized(factor) / name, image)

    _do_for_all(resize, image_names(layout.images), f"Resizing to 1/{factor}")


def _prepare_image(source: Path, target: Path, taken: Collection[Path]) -> Path:
    """Write the prepared photo and return its path, `_prepared_path`. taken: paths of other photos."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        with open_image(source) as image:
            target = _prepared_path(image, target, taken)
            if (
                image.format in _LINKED
                and image.getexif().get(_ORIENTATION, 1) in (0, 1)
                and not has_other_colors(image)
            ):
                link(source, target)
                return target
            upright = ImageOps.exif_transpose(image)
            exif = upright.getexif()
            mark_srgb(exif)
            _save_srgb(upright, target, image, exif=exif)
            return target
    except UNREADABLE as error:
        raise UserError(f"cannot rewrite the photo {source} for COLMAP ({error}); replace or remove it") from error


def _prepared_path(image: Image.Image, target: Path, taken: Collection[Path]) -> Path:
    """The path of a prepared photo: `target`, with the suffix of its format appended if it has none."""
    end = _ENDS[_written_format(image)]
    if target.suffix.lower() not in (set(SUFFIXES) - {".webp"} if image.format in _LINKED else {end}):
        target = target.with_name(target.name + end)
        while target in taken:
            target = target.with_name(target.name + end)
    return target


def _written_format(image: Image.Image) -> str:
    """The format in which a photo is written."""
    written = _WRITTEN.get(image.format, "PNG")
    return "PNG" if written == "JPEG" and image.has_transparency_data else written


def read_upright_size(photo: Path) -> tuple[int, int]:
    width, height = picture_size(photo, colors=True)  # UserError for a truncated file or one of another kind
    try:
        with open_image(photo) as image:
            lies = image.getexif().get(_ORIENTATION, 1) in _LYING
    except UNREADABLE as error:
        raise UserError(f"cannot read the EXIF data of {photo} ({error}); replace or remove the photo") from error
    return (height, width) if lies else (width, height)


def _check_mask(mask: Path, name: str, size: tuple[int, int]) -> None:
    found = picture_size(mask)
    if found != size:
        raise UserError(
            f"the mask {mask} has {found[0]} x {found[1]} pixels, but its photo {name} has {size[0]} x {size[1]} when "
            "it is upright; make masks from the photos as they are displayed"
        )


def _prepare_mask(source: Path | None, target: Path, photo: Path) -> None:
    """Write a mask as 8-bit grey PNG, in which black (0) is masked.

    Without a source, write a white mask: COLMAP skips photos without a mask if others have one.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    if source is None:
        Image.new("L", picture_size(photo), 255).save(target)
        return
    kept = Mask(source).decode(picture_size(source))[0].numpy()
    Image.fromarray(kept).save(target)


def _save_srgb(image: Image.Image, target: Path, like: Image.Image, **options: object) -> None:
    """Save in sRGB, in the format of the photo `like` that the image was made from."""
    target.parent.mkdir(parents=True, exist_ok=True)
    image = to_srgb(image)
    if profile := image.info.get("icc_profile"):
        options["icc_profile"] = profile
    written = _written_format(like)
    if written == "JPEG":
        options |= {"quality": JPEG_QUALITY, "subsampling": 0}
    image.save(target, written, **options)


def link(source: Path, target: Path) -> None:
    """Make a hard link to a photo, or a copy of it where links are impossible."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source.resolve(), target)
    except OSError:
        shutil.copyfile(source, target)


def _do_for_all(
    work: Callable[[str], None], names: Sequence[str], title: str, remedy: str = "replace or remove them"
) -> None:
    """Do the work for all names. If it raises UserError for any, raise one UserError that lists them.

    remedy: for several.
    """

    def attempt(name: str) -> UserError | None:
        try:
            work(name)
        except UserError as error:
            return error
        return None

    attempts = in_threads(attempt, names, desc=title)
    faults = [fault for fault in attempts if fault]
    if len(faults) == 1:
        raise faults[0]
    if faults:
        # List what is wrong with each, without the remedy, which is the same for all.
        listed = "; ".join(str(fault).partition("; ")[0] for fault in faults[:_MOST_NAMED])
        more = f"; and {len(faults) - _MOST_NAMED} more" if len(faults) > _MOST_NAMED else ""
        raise UserError(f"{len(faults)} of {len(names)} photos cannot be used: {listed}{more}; {remedy}")
