"""Views of a dataset, together with the Gaussians that are trained on them or loaded for them."""

import argparse
import json
import os
import random
import shutil
from collections.abc import Iterable, Sequence
from importlib import import_module
from itertools import chain
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

import numpy as np

from groundwork.files.json_files import ENLARGEMENT, OFFSET, read_model_json
from groundwork.host.machine import compute_device
from groundwork.ranks.ranks import ALONE, Ranks
from scene.camera_forms import call_either_form
from scene.cameras import Camera, camera_to_JSON, cameraList_from_camInfos, find_replacement
from scene.dataset_readers import find_reader_replacement, read_scene, read_scene_by
from scene.images.masks import MaskOptions, check_masks
from scene.images.store import ImageStore, Picture, image_device
from scene.readers.info import CameraInfo, SceneInfo, photo_size
from scene.readers.point_cloud import write_point_cloud
from scene.readers.scene_folder import kind_of
from scene.readers.tracks import enlargement
from utils.graphics_utils import BasicPointCloud
from utils.system_utils import UserError, atomic_write, find_iteration, saved_ply


class SceneGaussians(Protocol):
    """The part of GaussianModel that a scene needs, or the reference's class of that name.

    A scene sets `world_offset` and `enlargement`, and calls `load_exposures(folder, cam_infos)` and
    `save_exposures(folder)` with train_test_exp if there are such methods. Else it calls `load_ply(path, True)`, and
    writes exposure.json from `exposure_mapping` and `get_exposure_from_name(name)`, as the reference does.
    """

    def create_from_pcd(
        self, pcd: BasicPointCloud, cam_infos: Sequence[CameraInfo], spatial_lr_scale: float
    ) -> None: ...

    def load_ply(self, path: str) -> None: ...

    def save_ply(self, path: str) -> None: ...


class Scene:
    """Views and model of one run.

    args: model options, as ModelParams.extract gives them; the reference's of 2023 suffice. load_iteration: None calls
    `create_gaussians` and `write_inputs`; -1 loads the last saved iteration, N that one. start: False leaves all of
    this to the caller. shuffle: mix the order of the views (always the same way). resolution_scales: factors by which
    views are made smaller, one list of cameras each. train_cameras, test_cameras: these lists by scale, which may be
    replaced. info: the dataset as read. cameras_extent: E in world units, from the training views. images: the store of
    the decoded photos. ranks: processes that divide them (ImageStore). parts: of a training (splatting/part.py), None:
    those that args ask for. halves: only right halves of views are scored, as by ScoredViews. given_test_views: the
    held-out views as read, before parts changed the dataset.
    """

    def __init__(
        self,
        args: argparse.Namespace,
        gaussians: SceneGaussians,
        load_iteration: int | None = None,
        shuffle: bool = True,
        resolution_scales: Sequence[float] = (1.0,),
        start: bool = True,
        ranks: Ranks = ALONE,
        parts: Sequence[Any] | None = None,
    ) -> None:
        """Read the dataset of `args` and make its cameras; fill `gaussians` from points or from a saved model.

        load_iteration: iteration to load, -1: the last; None: a new model. start: whether to fill `gaussians`. parts:
        of the training, None: those that `args` choose. shuffle, resolution_scales: as in the reference.
        """
        self.model_path = args.model_path
        self.gaussians = gaussians
        self.loaded_iter = load_iteration
        if load_iteration is not None and start:
            self.loaded_iter = find_iteration(self.model_path, load_iteration)
        self.parts = registry_of_parts().chosen(args) if parts is None else parts
        self.halves = False
        self.info = self._read(args)
        self.cameras_extent = self.info.extent

        device = compute_device()
        place = image_device(args.data_device, device, warn=True)
        self.images = ImageStore(getattr(args, "images_to_load", None) or 0, place, device, ranks)
        self.train_cameras, self.test_cameras = (
            {scale: self._make_cameras(args, scale, shuffle, views, test) for scale in resolution_scales}
            for views, test in ((self.info.train_cameras, False), (self.info.test_cameras, True))
        )
        trained, tested = (self._list_pictures(chain(*of.values())) for of in (self.train_cameras, self.test_cameras))
        self.images.plan(trained, tested)

        gaussians.world_offset = tuple(self.info.offset.tolist())
        if self.loaded_iter is None:
            gaussians.enlargement = enlargement(self.info)
        else:
            gaussians.enlargement = read_model_json(self.model_path).get(ENLARGEMENT, 1.0)
        if not start:
            return
        if self.loaded_iter is not None:
            print(f"Loading trained model at iteration {self.loaded_iter}")
            gaussians.load_ply(str(saved_ply(self.model_path, self.loaded_iter)))
            self.load_parts(args)
        else:
            self.create_gaussians()
            self.write_inputs()

    def _read(self, args: argparse.Namespace) -> SceneInfo:
        """The dataset as the options and the parts want it."""
        fresh = self.loaded_iter is None
        if fresh:
            _refuse_dataset_folder(args)
        kind = kind_of(args.source_path)
        if read := find_reader_replacement(kind):
            info = read_scene_by(read, kind, args)
        else:
            masks = MaskOptions(**_list_given(args, folder="masks", invert="invert_masks", meaning="mask_meaning"))
            info = read_scene(
                args.source_path,
                args.images,
                args.eval,
                want_cloud=fresh,
                masks=masks,
                offset=None if fresh else read_model_json(self.model_path).get(OFFSET, (0, 0, 0)),
                kind=kind,
                native=getattr(args, "lenses", "") == "native",
                **_list_given(args, init_pcd_path="init_pcd_path", init_type="init_type", rule="holdout"),
            )
            if fresh:
                check_masks([(view.image_path, view.mask) for view in info.train_cameras + info.test_cameras], masks)
        self.given_test_views = info.test_cameras
        for part in self.parts:
            info = part.dataset(info, args, fresh)
        return info

    def getTrainCameras(self, scale: float = 1.0) -> list[Camera]:
        """Training views at a resolution scale that the scene was made with."""
        return self.train_cameras[scale]

    def getTestCameras(self, scale: float = 1.0) -> list[Camera]:
        """Held-out views at a resolution scale that the scene was made with."""
        return self.test_cameras[scale]

    def prefetch(self, cameras: Sequence[Camera]) -> None:
        """Start to prepare the images of the views that come next, in that order (`images.ahead` of them)."""
        self.images.prefetch(self._list_pictures(cameras))

    def save(self, iteration: int, gaussians: SceneGaussians | None = None) -> None:
        """Write `point_cloud/iteration_N/point_cloud.ply`, and what parts write beside it.

        gaussians: written in place of the scene's own; what parts write is always of the scene.
        """
        self.save_parts()
        (self.gaussians if gaussians is None else gaussians).save_ply(str(saved_ply(self.model_path, iteration)))

    def save_parts(self) -> None:
        """Write the files of parts into the model folder."""
        for part in self.parts:
            part.save(self)

    def load_parts(self, args: argparse.Namespace) -> None:
        """Read the files of parts in the model folder. args: the model options."""
        for part in self.parts:
            part.load(self, args)

    def training_pixels(self) -> tuple[int, int]:
        """Pixels of all training views: at training size, and in the photos."""
        trained = sum(camera.image_width * camera.image_height for camera in self.getTrainCameras())
        return trained, sum(width * height for width, height in map(photo_size, self.info.train_cameras))

    def create_gaussians(self) -> None:
        """Start from the dataset's points."""
        cloud, views, extent = self.info.point_cloud, self.info.train_cameras, self.cameras_extent
        call_either_form(self.gaussians.create_from_pcd, (cloud, views, extent), (cloud, extent))

    def write_inputs(self) -> None:
        """Write the cloud and the cameras into the model folder, `input.ply` and `cameras.json`."""
        folder, info = Path(self.model_path), self.info
        if info.ply_path and not info.offset.any():
            with atomic_write(folder / "input.ply") as path:
                shutil.copyfile(info.ply_path, path)
        else:
            colors = np.round(info.point_cloud.colors * 255).astype(np.uint8)
            write_point_cloud(folder / "input.ply", info.point_cloud.points, colors)
        entry = find_replacement("camera_to_JSON") or camera_to_JSON
        entries = [entry(i, camera) for i, camera in enumerate([*info.test_cameras, *info.train_cameras])]
        with atomic_write(folder / "cameras.json") as path:
            path.write_text(json.dumps(entries, allow_nan=False), encoding="utf-8")

    def _make_cameras(
        self, args: argparse.Namespace, scale: float, shuffle: bool, views: Sequence[CameraInfo], test: bool
    ) -> list[Camera]:
        """Cameras of views, which are held out (test) or train, in the same order at every scale."""
        cameras_of = find_replacement("cameraList_from_camInfos") or cameraList_from_camInfos
        cameras = list(cameras_of(views, scale, args, self.info.is_nerf_synthetic, test))
        ours = [(camera, view) for camera, view in zip(cameras, views, strict=False) if isinstance(camera, Camera)]
        for camera, _ in ours:
            camera.images = self.images
        for part in self.parts:
            part.cameras(self, ours, test)
        if shuffle:
            # A generator of its own: a resumed run must get the same order, whatever drew random numbers before.
            random.Random(0).shuffle(cameras)
        return cameras

    def _list_pictures(self, cameras: Iterable[Camera]) -> list[Picture]:
        """Those of our cameras; cameras of other classes have none."""
        return [p for camera in cameras if getattr(camera, "images", None) is self.images for p in camera.undecoded]


def registry_of_parts() -> ModuleType:
    """Return splatting.registry, which lies above, for a call that brings no parts, as the reference's do."""
    return import_module("splatting.registry")


def _list_given(args: argparse.Namespace, **names: str) -> dict[str, Any]:
    """Options that `args` has, by other names; code written for the reference lacks those that we added."""
    values = {name: getattr(args, option, None) for name, option in names.items()}
    return {name: value for name, value in values.items() if value is not None}


def _refuse_dataset_folder(args: argparse.Namespace) -> None:
    """UserError when `write_inputs` would overwrite a file of the dataset.

    It writes both names, so a folder that has only one of them has a file of someone else.
    """
    if not args.source_path or not args.model_path:
        return
    source, model = Path(args.source_path).resolve(), Path(args.model_path).resolve()
    found = [name for name in ("input.ply", "cameras.json") if (model / name).exists()]
    if model == source and len(found) == 1:
        raise UserError(
            f"a model in {args.model_path} would overwrite the scene's {found[0]}; name another folder with -m"
        )


def load_exposures(scene: Any) -> None:
    """Load the exposures of a scene's training views, whose PLY is loaded; the reference's model reads both at once."""
    if load := getattr(scene.gaussians, "load_exposures", None):
        load(scene.model_path, scene.info.train_cameras)
    else:
        scene.gaussians.load_ply(str(saved_ply(scene.model_path, scene.loaded_iter)), True)


def save_exposures(gaussians: SceneGaussians, folder: str | os.PathLike) -> None:
    """Write exposure.json into a model folder, also for a model that cannot do so itself."""
    if save := getattr(gaussians, "save_exposures", None):
        save(folder)
    elif names := list(getattr(gaussians, "exposure_mapping", ())):
        table = {name: gaussians.get_exposure_from_name(name).tolist() for name in names}
        with atomic_write(Path(folder) / "exposure.json") as path:
            path.write_text(json.dumps(table, indent=2), encoding="utf-8")
