"""Poses that are trained with the Gaussians (--refine_poses): a small correction of each training camera's pose."""

import argparse
import copy
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from groundwork.files.json_files import read_json, write_json
from groundwork.finding import Finding, note
from scene.cameras import Camera
from scene.checks.fit import pose_errors, poses_differ
from scene.readers.info import CameraInfo, SceneInfo
from scene.readers.tracks import PhotoPoints
from scene.scene import Scene
from splatting.features.refine_poses_steps import PoseRefinement
from splatting.part import Needs, Part, Scored
from splatting.records.renders import GIVEN_POSES
from utils.system_utils import UserError

NAME = "poses.json"
_WITHOUT = "write refine_poses=false into model.json to render from the dataset's poses"
_REMEDY = f"save the model again, or {_WITHOUT}"


class RefinePoses(Part):
    """Gives the cameras trained poses, whose steps are taken on the host, and keeps the poses in poses.json."""

    name = "refine_poses"
    needs = Needs(files=True)
    against = {"projection=ray": "which has no gradients of poses; leave one of them out"}

    @classmethod
    def joins_by_state(cls, given: argparse.Namespace, iteration: int) -> bool:
        raise UserError(f"{given.start_checkpoint} was trained with --{cls.name}; give that option")

    def dataset(self, info: SceneInfo, args: argparse.Namespace, fresh: bool) -> SceneInfo:
        self._elsewhere = bool(getattr(args, "other_scene", ""))
        return info if fresh or self._elsewhere else with_poses(info, args.model_path)

    def begin(self, run: Any, state: Any) -> None:
        self.poses = PoseRefinement(run.scene, run.dataset.source_path, run.opt.iterations)
        if run.start:
            self.poses.restore(state)
        run.camera_steps = self.poses

    def records(self) -> dict[str, float]:
        return self.poses.corrections()

    def state(self) -> dict[str, Any]:
        return self.poses.captured()

    def scored(self, scene: Scene, pipe: argparse.Namespace, background: Any) -> dict[str, Scored]:
        """Return the test views with the dataset's poses."""
        views = [] if self._elsewhere else [copy.copy(camera) for camera in scene.getTestCameras()]
        for camera in views:
            given = scene.given_test_views[camera.uid]
            camera.place(given.R, given.T)
        return {GIVEN_POSES: (None, views)} if views else {}

    def save(self, scene: Scene) -> None:
        write_poses(scene.model_path, scene.getTrainCameras(), scene.getTestCameras())

    @staticmethod
    def advise(scene: Scene, tracks: Sequence[PhotoPoints | None]) -> Iterator[Finding]:
        """Measure whether the tracks suggest other poses."""
        found = pose_errors(scene.info.train_cameras, tracks, scene.cameras_extent) if any(tracks) else None
        if found is not None:
            given, best = found
            text = f"points lie {given:.2g} pixels from where photos show them (median), and {best:.2g} with better"
            yield note(f"{text} poses", "--refine_poses" if poses_differ(given, best) else "")


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
    """Return a dataset with the poses of a folder's poses.json. UserError for a file that does not fit the dataset."""
    path = Path(folder) / NAME
    try:
        table = dict(read_json(path))
    except OSError as error:
        raise UserError(f"cannot read {path} ({error.strerror}); {_REMEDY}") from error
    except (TypeError, ValueError, RecursionError) as error:
        raise UserError(f"{path} is no table of poses; {_REMEDY}") from error
    lists = {name: getattr(info, f"{name}_cameras") for name in ("train", "test")}
    return info._replace(
        **{f"{name}_cameras": _place_views(views, table.get(name), path) for name, views in lists.items()}
    )


def _place_views(views: Sequence[CameraInfo], entries: Any, path: Path) -> list[CameraInfo]:
    """Return the views with the poses of a list in poses.json. UserError for a list that does not fit the views.

    entries: list of tables with img_name, R (3, 3) and T (3,); it may be anything else if the file is damaged.
    path: file of the list, for messages.
    """
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
