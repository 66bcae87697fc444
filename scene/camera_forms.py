"""The arguments of the reference's Camera, in the form of either release."""

import inspect
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from scene.images.decode import pixels_of
from scene.images.store import InMemory, Size
from scene.readers.depth_maps import depth_fit, fitted
from scene.readers.info import CameraInfo
from utils.general_utils import check_flags
from utils.image_utils import half

NOT_MOVED = np.array([0.0, 0.0, 0.0])
Arguments = tuple[tuple[CameraInfo, Size, int], dict[str, Any]]  # of a Camera made of a CameraInfo


def of_either_form(*args: Any, **kwargs: Any) -> Arguments:
    """Arguments of either form, told apart by `gt_alpha_mask`, or by the first argument: a size or an id.

    TypeError for arguments of neither form.
    """
    older = "gt_alpha_mask" in kwargs or (bool(args) and np.ndim(args[0]) == 0)
    return _of_2023(*args, **kwargs) if older else _of_2024(*args, **kwargs)


def _of_2024(
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
    """Arguments of the newer release.

    resolution: (width, height) that the image is resized to, its alpha included. invdepthmap: (h,w) or (h,w,C), whose
    first channel counts, resized bilinearly. depth_params: as `depth_fit` takes them. train_test_exp: only a half of a
    test view (is_test_view) counts, by the list it is in (is_test_dataset). TypeError for flags that are no booleans.
    """
    check_flags(train_test_exp=train_test_exp, is_test_dataset=is_test_dataset, is_test_view=is_test_view)
    size = int(resolution[0]), int(resolution[1])
    depth: InMemory | None = None
    if invdepthmap is not None:
        fit, values = depth_fit(depth_params), np.asarray(invdepthmap, dtype=np.float64)
        depth = InMemory(fitted(values[..., 0] if values.ndim > 2 else values, size, fit.scale, fit.offset))
    info = CameraInfo(
        *(colmap_id, R, T, FoVy, FoVx, depth_params, "", image_name, "", *size),
        image=InMemory(pixels_of(image, size)),
        depth=depth,
    )
    columns = half(size[0], is_test_dataset) if train_test_exp and is_test_view else None
    return (info, size, uid), {"columns": columns, "trans": trans, "scale": scale, "data_device": data_device}


def _of_2023(
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
    """Arguments of the release of 2023.

    image: (3,H,W), clamped to [0,1] and multiplied by gt_alpha_mask, (1,H,W) in [0,1], or None: opaque.
    """
    pixels = image.clamp(0.0, 1.0)
    if gt_alpha_mask is not None:
        alpha = gt_alpha_mask.to(pixels).reshape(-1, *pixels.shape[1:])[:1]
        pixels = torch.cat([pixels * alpha, alpha])
    size = pixels.shape[2], pixels.shape[1]
    info = CameraInfo(*(colmap_id, R, T, FoVy, FoVx, None, "", image_name, "", *size), image=InMemory(pixels))
    return (info, size, uid), {"trans": trans, "scale": scale, "data_device": data_device}


SIGNATURE = inspect.signature(_of_2024).replace(return_annotation=inspect.Signature.empty)
