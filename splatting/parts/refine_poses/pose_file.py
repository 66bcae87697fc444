"""poses.json: the refined poses of a model's views (--refine_poses)."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scene.cameras import Camera
from scene.readers.info import CameraInfo, SceneInfo
from splatting.files.json_files import read_json, write_json
from utils.system_utils import UserError

NAME = "poses.json"
_WITHOUT = "write refine_poses=false into model.json to render from the dataset's poses"
_REMEDY = f"save the model again, or {_WITHOUT}"


def write_poses(folder: str | os.PathLike, train: Sequence[Camera], test: Sequence[Camera]) -> None:
    """Write the poses of both lists of cameras, in the dataset's order: names, and R and T as `Camera` has them."""
    lists = {"train": train, "test": test}
    table = {
        name: [
            {"img_name": camera.image_name, "R": np.asarray(camera.R).tolist(), "T": np.asarray(camera.T).tolist()}
            for camera in sorted(cameras, key=lambda camera: camera.uid)
        ]
        for name, cameras in lists.items()
    }
    write_json(Path(folder) / NAME, table)


def with_poses(info: SceneInfo, folder: str | os.PathLike) -> SceneInfo:
    """A dataset with the poses of a model folder's poses.json. UserError for a file that does not fit the dataset."""
    path = Path(folder) / NAME
    try:
        table = dict(read_json(path))
    except OSError as error:
        raise UserError(f"cannot read {path} ({error.strerror}); {_REMEDY}") from error
    except (TypeError, ValueError, RecursionError) as error:
        raise UserError(f"{path} is no table of poses; {_REMEDY}") from error
    lists = {name: getattr(info, f"{name}_cameras") for name in ("train", "test")}
    return info._replace(**{f"{name}_cameras": _placed(views, table.get(name), path) for name, views in lists.items()})


def _placed(views: Sequence[CameraInfo], entries: Any, path: Path) -> list[CameraInfo]:
    names = [view.image_name for view in views]
    try:
        if [entry["img_name"] for entry in entries] != names:
            raise UserError(f"{path} is of other views than the scene's; {_REMEDY}")
        poses = [(np.array(entry["R"], dtype=np.float64), np.array(entry["T"], np.float64)) for entry in entries]
    except (TypeError, KeyError, ValueError) as error:
        raise UserError(f"{path} has no list of poses; {_REMEDY}") from error
    if any(R.shape != (3, 3) or T.shape != (3,) for R, T in poses):
        raise UserError(f"{path} has a pose that is not R (3, 3) and T (3,); {_REMEDY}")
    if any("lens" in entry for entry in entries):
        raise UserError(f"{path} has refined lenses, which this version does not support; {_WITHOUT}")
    return [view._replace(R=R, T=T) for view, (R, T) in zip(views, poses, strict=True)]
