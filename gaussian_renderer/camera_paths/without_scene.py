"""Cameras of a model whose scene is missing: those recorded in its folder, or cameras on a circle around it.

`have_moved` compares recorded cameras with a scene's.
"""

import argparse
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_renderer.camera_paths.poses import look_along, positions_of, spread_of
from groundwork.files.json_files import read_json
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.gaussians.morton import sort_scattered
from scene.images.sizes import training_size
from scene.readers.info import CameraInfo
from scene.saved_model import find_save, load_saved, read_model
from scene.scene import Scene
from scene.with_splats import place
from utils.system_utils import UserError

RECORD = "cameras.json"  # in a model folder
_CORRECTED = "poses.json"  # there, if the training corrected the dataset's poses, which the record has
COUNT, SIZE = 12, (960, 720)  # of the circle's views
_FOCAL = 0.9  # of their widths
_FAR = 3.5  # their distance, in median distances of the means from the middle
_HIGH = 0.3  # of their distance
_MOVED = 1e-3  # of the mean distance of cameras from their middle; other programs round the poses that they record


@dataclass
class WithoutScene:
    """A stand-in for a scene whose cameras have no photos. loaded_iter: the iteration, or a name."""

    gaussians: GaussianModel
    model_path: str
    loaded_iter: int | str
    train: Sequence[Camera]
    test: Sequence[Camera] = field(default_factory=list)
    halves: bool = False

    def getTrainCameras(self) -> list[Camera]:
        return list(self.train)

    def getTestCameras(self) -> list[Camera]:
        return list(self.test)


def recorded_cameras_file(options: argparse.Namespace) -> Path | None:
    """The cameras.json of a model folder whose scene is missing; None if the scene is there, or the file is not.

    options: the model options.
    """
    record = Path(options.model_path) / RECORD
    if os.path.isdir(options.source_path or "") or not record.is_file():
        return None
    print(f"warning: the scene {options.source_path} is gone, so there are poses, but no photos", file=sys.stderr)
    return record


def saved_scene(options: argparse.Namespace, iteration: int, sh_degree: int | None = None) -> Scene | WithoutScene:
    """Load the model of a folder with its scene (`load_saved`), or with the cameras of `recorded_cameras_file`."""
    if (record := recorded_cameras_file(options)) is None:
        return load_saved(options, iteration, sh_degree)
    iteration, path = find_save(options.model_path, iteration)
    gaussians = read_model(path, sh_degree)
    place(gaussians, options.model_path)
    sort_scattered(gaussians)
    return WithoutScene(gaussians, options.model_path, iteration, recorded_cameras(record, options.resolution))


def circle_cameras(means: np.ndarray) -> list[Camera]:
    """Make views on a circle that look at the median of positions (N, 3). Up is -y, as in most models."""
    middle = np.median(means, axis=0).astype(np.float64) if len(means) else np.zeros(3)
    radius = _FAR * float(np.median(np.linalg.norm(means - middle, axis=1))) if len(means) else 0.0
    infos = []
    for number, angle in enumerate(2 * np.pi * np.arange(COUNT) / COUNT):
        away = np.array([np.sin(angle), -_HIGH, -np.cos(angle)])
        turn = look_along(-away, np.array([0.0, -1.0, 0.0]))
        infos.append(
            _make_info(number, f"around {number}", turn, middle + (radius or 1.0) * away, *SIZE, _FOCAL * SIZE[0])
        )
    return _make_cameras(infos)


def recorded_cameras(path: Path, resolution: int = 1) -> list[Camera]:
    """The cameras of a model folder's cameras.json, at the size that option -r makes of their photos.

    UserError if there is none, or it is damaged.
    """
    try:
        return _make_cameras([_read_entry(number, entry) for number, entry in enumerate(read_json(path))], resolution)
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path} has no cameras that can be read ({error}); give the scene with -s") from error


def warn_if_moved(model: str | os.PathLike, cameras: Sequence[Camera]) -> None:
    """Print a warning if `have_moved`."""
    if have_moved(Path(model), cameras):
        print(
            f"warning: the scene's poses are not those that {model} was trained with, so the model does not fit its "
            "photos; train again, or name its scene by -s",
            file=sys.stderr,
        )


def have_moved(folder: Path, cameras: Sequence[Camera]) -> bool:
    """Tell whether cameras are at other places than the same names in a model folder's cameras.json.

    False if the file has none of them, or if the training corrected poses.
    """
    if (folder / _CORRECTED).is_file():
        return False
    try:
        recorded = {camera.image_name: camera for camera in recorded_cameras(folder / RECORD)}
    except (OSError, UserError):
        return False
    pairs = [(camera, recorded[camera.image_name]) for camera in cameras if camera.image_name in recorded]
    if not pairs:
        return False
    now, then = (positions_of(each) for each in zip(*pairs, strict=True))
    apart = np.linalg.norm(now - then, axis=1)
    return bool(np.median(apart) > _MOVED * spread_of(then) > 0)


def _read_entry(number: int, entry: Mapping[str, Any]) -> CameraInfo:
    turn, place = (np.array(entry[name], np.float64) for name in ("rotation", "position"))
    numbers = (int(entry["width"]), int(entry["height"]), float(entry["fx"]), float(entry["fy"]))
    return _make_info(number, str(entry["img_name"]), turn, place, *numbers)


def _make_info(
    number: int, name: str, turn: np.ndarray, place: np.ndarray, width: int, height: int, fx: float, fy: float = 0.0
) -> CameraInfo:
    options = {"image_name": name, "image_path": name, "width": width, "height": height}
    return CameraInfo(number, turn, -turn.T @ place, fx=fx, fy=fy or fx, **options)


def _make_cameras(infos: Sequence[CameraInfo], resolution: int = 1) -> list[Camera]:
    sizes = (training_size(info.width, info.height, resolution) for info in infos)
    return [Camera(info, size, number) for number, (info, size) in enumerate(zip(infos, sizes, strict=True))]
