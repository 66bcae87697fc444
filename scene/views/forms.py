"""Views made of the arguments that the reference's Camera takes, in the form of either of its releases."""

import inspect
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from scene.images.decode import pixels_of
from scene.images.in_memory import InMemory
from scene.readers.depth_maps import depth_fit, resize
from scene.views.view import View, half
from utils.general_utils import check_flags

_NOT_MOVED = np.array([0.0, 0.0, 0.0])


def view_of_2024(
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
    trans: np.ndarray = _NOT_MOVED,
    scale: float = 1.0,
    data_device: str = "cuda",
    train_test_exp: bool = False,
    is_test_dataset: bool = False,
    is_test_view: bool = False,
) -> View:
    """View of the arguments that the reference's newer release takes.

    resolution: (width, height) that the image is resized to, its alpha included. invdepthmap: (h,w) or (h,w,C), whose
    first channel counts, resized bilinearly. depth_params: as `depth_fit` takes them. train_test_exp: only a half of a
    test view (is_test_view) counts, by the list it is in (is_test_dataset). TypeError for flags that are no booleans.
    """
    check_flags(train_test_exp=train_test_exp, is_test_dataset=is_test_dataset, is_test_view=is_test_view)
    size = int(resolution[0]), int(resolution[1])
    fit = depth_fit(depth_params)
    depth: InMemory | None = None
    if invdepthmap is not None:
        values = np.asarray(invdepthmap, dtype=np.float64)
        values = np.maximum(resize(values[..., 0] if values.ndim > 2 else values, size), 0.0)
        depth = InMemory(torch.from_numpy((values * fit.scale + fit.offset).astype(np.float32))[None])
    return View(
        uid,
        colmap_id,
        R,
        T,
        FoVx,
        FoVy,
        image_name,
        size,
        InMemory(pixels_of(image, size)),
        depth=depth,
        depth_reliable=depth is not None and fit.reliable,
        columns=half(size[0], is_test_dataset) if train_test_exp and is_test_view else None,
        trans=trans,
        scale=scale,
        data_device=data_device,
    )


def view_of_2023(
    colmap_id: int,
    R: np.ndarray,
    T: np.ndarray,
    FoVx: float,
    FoVy: float,
    image: Tensor,
    gt_alpha_mask: Tensor | None,
    image_name: str,
    uid: int,
    trans: np.ndarray = _NOT_MOVED,
    scale: float = 1.0,
    data_device: str = "cuda",
) -> View:
    """View of the arguments that the reference's release of 2023 takes.

    image: (3,H,W), clamped to [0,1] and multiplied by gt_alpha_mask, (1,H,W) in [0,1], or None: opaque.
    """
    pixels = image.clamp(0.0, 1.0)
    if gt_alpha_mask is not None:
        alpha = gt_alpha_mask.to(pixels).reshape(-1, *pixels.shape[1:])[:1]
        pixels = torch.cat([pixels * alpha, alpha])
    size = pixels.shape[2], pixels.shape[1]
    return View(
        uid,
        colmap_id,
        R,
        T,
        FoVx,
        FoVy,
        image_name,
        size,
        InMemory(pixels),
        trans=trans,
        scale=scale,
        data_device=data_device,
    )


def view_of(*args: Any, **kwargs: Any) -> View:
    """View of the arguments of either form, told apart by `gt_alpha_mask`, or by the first argument: a size or an id.

    A View is returned as it is. TypeError for arguments of neither form.
    """
    if len(args) == 1 and not kwargs and isinstance(args[0], View):
        return args[0]
    older = "gt_alpha_mask" in kwargs or (bool(args) and np.ndim(args[0]) == 0)
    return view_of_2023(*args, **kwargs) if older else view_of_2024(*args, **kwargs)


SIGNATURE = inspect.signature(view_of_2024).replace(return_annotation=inspect.Signature.empty)
