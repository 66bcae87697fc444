"""Views of a dataset's records, whose pictures are decoded when they are first used."""

from pathlib import Path

from PIL import Image

from scene.images.decode import picture_size, pixels_of
from scene.images.in_memory import InMemory
from scene.images.masks import TRANSPARENT, Cutout, Mask, add_alpha
from scene.images.store import Size, Source
from scene.readers.depth_maps import BLENDER_UNIT, COLMAP_UNIT, DepthFit, DepthMap, depth_fit
from scene.readers.info import CameraInfo
from scene.views.view import View


def file_size(info: CameraInfo) -> Size:
    """Size (width, height) of a record's photo. UserError if it cannot be read."""
    size, image = getattr(info, "file_size", None), _image(info)
    return size or (picture_size(Path(info.image_path)) if image is None else image.size)


def view_of_info(info: CameraInfo, uid: int, size: Size, unit_of_blender: bool = False) -> View:
    """View of a CameraInfo, or of any record with the reference's fields, at a size (width, height).

    unit_of_blender: values of the record's `depth_path` are 1/512, not 1/65536. UserError if that file is missing.
    """
    source, mask = _photo(info, size)
    depth, fit = _depth(info, BLENDER_UNIT if unit_of_blender else COLMAP_UNIT)
    return View(
        uid=uid,
        colmap_id=info.uid,
        R=info.R,
        T=info.T,
        FoVx=info.FovX,
        FoVy=info.FovY,
        image_name=info.image_name,
        size=size,
        source=source,
        image_path=None if info.image_path is None else Path(info.image_path),
        mask=mask,
        ignore_alpha=getattr(info, "ignore_alpha", False),
        depth=depth,
        depth_reliable=depth is not None and fit.reliable,
        offset=(_offset(info, "cx", info.width), _offset(info, "cy", info.height)),
    )


def _photo(info: CameraInfo, size: Size) -> tuple[Source | InMemory, Mask | None]:
    """The photo with its alpha, and the mask that is not part of it."""
    image, mask = _image(info), getattr(info, "mask", None)
    cut = mask is not None and mask.meaning == TRANSPARENT
    if image is not None:
        pixels = pixels_of(image, size)
        return InMemory(add_alpha(pixels, mask.decode(size)) if cut else pixels), None if cut else mask
    path = Path(info.image_path)
    return (Cutout(path, mask), None) if cut else (path, mask)


def _image(info: CameraInfo) -> Image.Image | None:
    return getattr(info, "image", None)


def _offset(info: CameraInfo, name: str, pixels: int) -> float:
    center = getattr(info, name, None)
    return 0.0 if center is None else 2 * center / pixels - 1


def _depth(info: CameraInfo, unit: float) -> tuple[Source | None, DepthFit]:
    known = getattr(info, "depth", None)
    path = getattr(info, "depth_path", None)
    if known is not None or not path:
        return known, DepthFit()
    picture_size(Path(path))  # so that a missing file is named now
    fit = depth_fit(info.depth_params)
    return DepthMap(Path(path), unit, fit.scale, fit.offset), fit
