"""NerfBaselines' cameras, photos and points as the records that our readers return."""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from scene.dataset_readers import sceneLoadTypeCallbacks
from scene.images.lens import Lens
from scene.readers.info import CameraInfo, SceneInfo
from scene.readers.photos import camera_info
from scene.readers.point_cloud import color_fractions
from scene.readers.scene_folder import COLMAP
from scene.readers.start_cloud import StartCloud, StartOptions, random_for_blender, random_in_frusta, scene_info
from utils.graphics_utils import BasicPointCloud
from utils.system_utils import UserError

# By their numbers at NerfBaselines: COLMAP's model, and the places of its parameters in k1, k2, p1, p2, k3 ... k6.
MODELS = (
    ("PINHOLE", ()),
    ("OPENCV", (0, 1, 2, 3)),
    ("OPENCV_FISHEYE", (0, 1, 4, 5)),
    ("FULL_OPENCV", (0, 1, 2, 3, 4, 5, 6, 7)),
)


def view_of(camera: Any, index: int = 0, name: str = "view", path: str = "", **more: Any) -> CameraInfo:
    """The record of one camera of NerfBaselines, whose frame is x right, y down, z forward, as ours.

    more: further fields of the record.
    """
    model, places = MODELS[int(camera.camera_models)]
    distortion = np.zeros(8)
    distortion[: len(camera.distortion_parameters)] = camera.distortion_parameters
    numbers = (*camera.intrinsics, *distortion[list(places)])
    lens = Lens(model, tuple(map(float, numbers)), *map(int, camera.image_sizes))
    pose = np.asarray(camera.poses, dtype=np.float64)
    R = pose[:3, :3]
    return camera_info(index, name, Path(path), lens, R, -R.T @ pose[:3, 3], native=True)._replace(**more)


def scene_of(dataset: Mapping[str, Any], start: StartOptions) -> SceneInfo:
    """The training views of a dataset, with their photos in memory, and its points or random ones.

    Pixels that its masks leave out do not count. UserError for photos that are no 8-bit sRGB.
    """
    cameras, masks = dataset["cameras"], dataset["masks"]
    views = []
    for index, (camera, pixels) in enumerate(zip(cameras, dataset["images"], strict=True)):
        path = dataset["image_paths"][index]
        name = os.path.relpath(path, dataset["image_paths_root"])
        if pixels.dtype != np.uint8:
            raise UserError(f"the photo {name} has pixels of {pixels.dtype}; give a dataset of 8-bit sRGB photos")
        width, height = camera.image_sizes
        pixels = pixels[:height, :width]  # NerfBaselines may have padded it
        if masks is not None:
            counts = np.asarray(masks[index])[:height, :width] > 0
            pixels = np.dstack([pixels[..., :3], np.where(counts, 255, 0).astype(np.uint8)])
        photo = {"image": Image.fromarray(pixels), "ignore_alpha": masks is not None}
        views.append(view_of(camera, index, name, path, **photo))

    def own() -> StartCloud:
        """Make the start cloud of the data set's points, or random points if there are none."""
        points, colors = dataset["points3D_xyz"], dataset["points3D_rgb"]
        if points is None:
            return StartCloud(random(), None, is_random=True)
        colors = np.full(points.shape, 0.5) if colors is None else color_fractions(np.asarray(colors), "points3D_rgb")
        return StartCloud(BasicPointCloud(points.astype(np.float32), colors, np.zeros_like(points)), None)

    def random() -> BasicPointCloud:
        synthetic = dataset["metadata"].get("background_color") is not None
        return random_for_blender(views, "the dataset") if synthetic else random_in_frusta(views)

    return scene_info((views, []), start, own, random, "the dataset has no points")


def has_white_background(dataset: Mapping[str, Any]) -> bool:
    """Tell if transparent parts of the photos count as white."""
    color = dataset["metadata"].get("background_color")
    return color is not None and bool(np.all(np.asarray(color) == 255))


@contextmanager
def in_place_of_files(info: SceneInfo, folder: Path) -> Iterator[str]:
    """A scene folder, made in `folder`, that within this context is read as `info`."""
    (folder / "sparse").mkdir(parents=True)
    ours = sceneLoadTypeCallbacks[COLMAP]
    sceneLoadTypeCallbacks[COLMAP] = lambda *_: info
    try:
        yield str(folder)
    finally:
        sceneLoadTypeCallbacks[COLMAP] = ours
