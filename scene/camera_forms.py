"""Arguments, records and functions of other code, in the form of either release of the reference."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from scene.images.decode import picture_size, pixels_of
from scene.images.masks import TRANSPARENT, add_alpha
from scene.images.store import InMemory, Size
from scene.readers.depth_maps import BLENDER_UNIT, COLMAP_UNIT, DepthMap, apply_fit, depth_fit
from scene.readers.info import CameraInfo, as_camera_info
from utils.general_utils import check_flags
from utils.image_utils import half

NOT_MOVED = np.array([0.0, 0.0, 0.0])
Arguments = tuple[tuple[CameraInfo, Size, int], dict[str, Any]]  # of a Camera made of a CameraInfo


def parse_either_form(*args: Any, **kwargs: Any) -> Arguments:
    """Parse arguments of a Camera in either form, told apart by `gt_alpha_mask`, or by the first: a size or an id.

    TypeError for arguments of neither form.
    """
    older = "gt_alpha_mask" in kwargs or (bool(args) and np.ndim(args[0]) == 0)
    return _parse_2023(*args, **kwargs) if older else _parse_2024(*args, **kwargs)


def _parse_2024(
    resolution: Sequence[int],
    colmap_id: int,
    R: np.ndarray,
    T: np.ndarray,
    FoVx: float,
    FoVy: float,
    depth_params: Mapping[str, float] | None,
    image: Image.Image,
    invdepthmap: np.ndarray | None,
    image_name: str,
    uid: int,
    trans: np.ndarray = NOT_MOVED,
    scale: float = 1.0,
    data_device: str = "cuda",
    train_test_exp: bool = False,
    is_test_dataset: bool = False,
    is_test_view: bool = False,
) -> Arguments:
    """Parse arguments of the newer release.

    resolution: (width, height) that the image is resized to, its alpha included. invdepthmap: (h,w) or (h,w,C), whose
    first channel counts, resized bilinearly. depth_params: as `depth_fit` takes them. train_test_exp: only a half of a
    test view (is_test_view) counts, by the list it is in (is_test_dataset). TypeError for flags that are no booleans.
    """
    check_flags(train_test_exp=train_test_exp, is_test_dataset=is_test_dataset, is_test_view=is_test_view)
    size = int(resolution[0]), int(resolution[1])
    depth: InMemory | None = None
    if invdepthmap is not None:
        fit, values = depth_fit(depth_params), np.asarray(invdepthmap, dtype=np.float64)
        depth = InMemory(apply_fit(values[..., 0] if values.ndim > 2 else values, size, fit.scale, fit.offset))
    info = CameraInfo(
        *(colmap_id, R, T, FoVy, FoVx, depth_params, "", image_name, "", *size),
        image=InMemory(pixels_of(image, size)),
        depth=depth,
    )
    columns = half(size[0], is_test_dataset) if train_test_exp and is_test_view else None
    return (info, size, uid), {"columns": columns, "trans": trans, "scale": scale, "data_device": data_device}


def _parse_2023(
    colmap_id: int,
    R: np.ndarray,
    T: np.ndarray,
    FoVx: float,
    FoVy: float,
    image: Tensor,
    gt_alpha_mask: Tensor | None,
    image_name: str,
    uid: int,
    trans: np.ndarray = NOT_MOVED,
    scale: float = 1.0,
    data_device: str = "cuda",
) -> Arguments:
    """Parse arguments of the release of 2023.

    image: (3,H,W), clamped to [0,1] and multiplied by gt_alpha_mask, (1,H,W) in [0,1], or None: opaque.
    """
    pixels = image.clamp(0.0, 1.0)
    if gt_alpha_mask is not None:
        alpha = gt_alpha_mask.to(pixels).reshape(-1, *pixels.shape[1:])[:1]
        pixels = torch.cat([pixels * alpha, alpha])
    size = pixels.shape[2], pixels.shape[1]
    info = CameraInfo(*(colmap_id, R, T, FoVy, FoVx, None, "", image_name, "", *size), image=InMemory(pixels))
    return (info, size, uid), {"trans": trans, "scale": scale, "data_device": data_device}


SIGNATURE = inspect.signature(_parse_2024).replace(return_annotation=inspect.Signature.empty)


def info_from_record(record: Any, size: Size, is_nerf_synthetic: bool) -> CameraInfo:
    """Make a CameraInfo of any record with the reference's fields, photo and depth map ready for training at a size.

    A PIL image in the record is resized. A file that `depth_path` names is a depth map with Blender's unit if the scene
    is_nerf_synthetic, else with COLMAP's. UserError if that file is missing.
    """
    record = as_camera_info(record)
    if record.image is not None:
        pixels, mask = pixels_of(record.image, size), record.mask
        if mask and mask.meaning == TRANSPARENT:
            pixels, mask = add_alpha(pixels, mask.decode(size)), None
        record = replace(record, image=InMemory(pixels), mask=mask)
    if record.depth_path and record.depth is None:
        path, fit = Path(record.depth_path), depth_fit(record.depth_params)
        picture_size(path)  # so that a missing file is named now
        unit = BLENDER_UNIT if is_nerf_synthetic else COLMAP_UNIT
        record = replace(record, depth=DepthMap(path, unit, fit.scale, fit.offset))
    return record


def call_either_form(function: Callable, newer: tuple, older: tuple) -> Any:
    """Call a function that may be other code's of 2023 and then takes the older, fewer arguments."""
    return function(*(newer if takes(function, newer) else older))


def takes(function: Callable, arguments: tuple) -> bool:
    """Tell whether a function may be called with so many arguments."""
    try:
        inspect.signature(function).bind(*arguments)
    except TypeError:
        return False
    return True
