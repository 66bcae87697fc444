"""Cameras of a dataset's views, and their entries in `cameras.json`."""

import argparse
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from scene.cameras import Camera
from scene.images.decode import picture_size, pixels_of
from scene.images.masks import TRANSPARENT, Mask, add_alpha
from scene.images.sizes import training_size
from scene.images.store import InMemory, Size
from scene.readers.depth_maps import BLENDER_UNIT, COLMAP_UNIT, DepthMap, depth_fit
from scene.readers.info import CameraInfo, photo_size
from scene.reference_models import call_of_either_form
from utils.graphics_utils import camera_center, fov2focal, rigid_pose
from utils.image_utils import half

__all__ = ["Camera", "cameraList_from_camInfos", "camera_to_JSON", "loadCam"]


def loadCam(
    args: argparse.Namespace,
    id: int,
    cam_info: CameraInfo,
    resolution_scale: float,
    is_nerf_synthetic: bool = False,
    is_test_dataset: bool = False,
) -> Camera:
    """Camera at training size (args.resolution, divided by resolution_scale), whose photo is decoded on first use.

    args: resolution, data_device and train_test_exp count. id: uid of the camera. cam_info: a CameraInfo, or any record
    with the reference's fields. is_nerf_synthetic: depth maps named by `depth_path` have Blender's unit.
    is_test_dataset: the view is in the test list. UserError for a photo or depth map that cannot be read.
    """
    size = training_size(*photo_size(cam_info), args.resolution, resolution_scale)
    halved = getattr(args, "train_test_exp", False) and getattr(cam_info, "is_test", False)
    columns = half(size[0], is_test_dataset) if halved else None
    return Camera(_of_record(cam_info, size, is_nerf_synthetic), size, id, columns, data_device=args.data_device)


def _of_record(record: Any, size: Size, is_nerf_synthetic: bool) -> CameraInfo:
    """CameraInfo of any record with the reference's fields, whose photo and depth map are ready for training at a size.

    A PIL image that it holds is resized. A file that `depth_path` names is a depth map with Blender's unit if the scene
    is_nerf_synthetic, else with COLMAP's. UserError if that file is missing.
    """
    if type(record) is not CameraInfo:
        names = {field.name for field in fields(CameraInfo)} - {"fx", "fy", "lens"}
        values = {name: getattr(record, name) for name in names if hasattr(record, name)}
        values |= {name: float(values[name]) for name in ("cx", "cy") if values.get(name) is not None}
        if not isinstance(values.get("mask"), Mask):
            values["mask"] = None  # an attribute of other code by that name
        record = CameraInfo(**values)
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


def cameraList_from_camInfos(
    cam_infos: Sequence[CameraInfo],
    resolution_scale: float,
    args: argparse.Namespace,
    is_nerf_synthetic: bool = False,
    is_test_dataset: bool = False,
) -> list[Camera]:
    """`loadCam` of each view; their uids count from 0."""
    of_2024 = is_nerf_synthetic, is_test_dataset
    older = [(args, uid, info, resolution_scale) for uid, info in enumerate(cam_infos)]
    return [call_of_either_form(loadCam, (*arguments, *of_2024), arguments) for arguments in older]


def camera_to_JSON(id: int, camera: CameraInfo) -> dict[str, object]:
    """Entry of `cameras.json`, keys in the order that viewers expect: camera-to-world pose, full-size intrinsics.

    camera: any object with R, T, FovX, FovY, width, height and image_name; its fx and fy count if it has them.
    """
    focal = {"fy": ("FovY", "height"), "fx": ("FovX", "width")}
    R, T = rigid_pose(camera.R, camera.T, camera.image_name)
    return {
        "id": id,
        "img_name": camera.image_name,
        "width": camera.width,
        "height": camera.height,
        "position": camera_center(R, T).tolist(),
        "rotation": [row.tolist() for row in np.asarray(R)],
        **{
            name: getattr(camera, name, None) or fov2focal(getattr(camera, fov), getattr(camera, size))
            for name, (fov, size) in focal.items()
        },
    }
