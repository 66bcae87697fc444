# ruff: noqa: F401  (names of the reference, which other code imports from here)
"""Readers of datasets of all kinds: a folder becomes plain records.

`read_scene` is what training calls. The others have the reference's names, for code that calls them itself: each takes
the arguments of the October 2024 release, and those of the 2023 release where it can tell them apart. They compose the
same readers and write nothing into the dataset. Coordinates are the world's, even far from its origin. Paths in the
records are strings. Errors that the user can fix are UserErrors.
"""

import argparse
import hashlib
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from groundwork.files.folders import cache_folder
from groundwork.files.image_files import SUFFIXES
from groundwork.files.plain_files import plain_text
from scene.colmap_loader import Camera, Image
from scene.images.masks import NO_MASKS, MaskOptions
from scene.readers.colmap import colmap_camera, read_colmap
from scene.readers.depth_maps import BLENDER_UNIT, COLMAP_UNIT, with_depth_maps, with_map
from scene.readers.holdout import EVERY, refuse_rule
from scene.readers.info import (
    HOLD,
    CameraInfo,
    SceneInfo,
    camera_centers,
    local,
    normalization,
    scene_extent,
    world_offset,
)
from scene.readers.photos import to_pinholes
from scene.readers.point_cloud import fetchPly, storePly, write_point_cloud
from scene.readers.scene_folder import BLENDER, COLMAP, NERFSTUDIO, kind_of
from scene.readers.start_cloud import SFM, StartOptions
from scene.readers.transforms import read_blender, read_frames, read_nerfstudio
from utils.graphics_utils import BasicPointCloud, focal2fov, fov2focal
from utils.system_utils import UserError

StrPath = str | os.PathLike
_READERS: dict[str, Callable[..., SceneInfo]] = {
    COLMAP: read_colmap,
    BLENDER: read_blender,
    NERFSTUDIO: read_nerfstudio,
}


def read_scene(
    source_path: str | os.PathLike,
    images: str,
    hold_out: bool,
    init_pcd_path: str | BasicPointCloud = "",
    want_cloud: bool = True,
    init_type: str = SFM,
    masks: MaskOptions = NO_MASKS,
    offset: Sequence[float] | None = None,
    kind: str | None = None,
    native: bool = False,
    rule: str = EVERY,
) -> SceneInfo:
    """Read the dataset in a folder, of any kind. UserError says what was looked for and what was found.

    images: folder of the photos; another than "images" also replaces that which a camera file names. hold_out: keep a
    test set apart, else all views train.
    init_pcd_path: points, or a file of them, to start from instead of the dataset's own. Without one, init_type
    decides: "sfm" (the dataset's points) or "random". want_cloud: False reads no points, for a model that exists
    already. offset: (3,) of that model's frame (scene/readers/info.py); None: computed for this scene.
    kind: of the folder (`kind_of`), where it is known.
    native: take photos of distorting lenses as they are, where the rasterizer knows the camera model. Others are
    undistorted into the user's cache folder; nothing else is written.
    rule: which photos are held out (scene/readers/holdout.py), where the dataset does not list them.
    """
    if rule != EVERY and not hold_out:
        raise UserError(f"--holdout {rule} holds photos out only with --eval; give --eval, too")
    start = StartOptions(init_pcd_path, init_type) if want_cloud else None
    kind = kind or kind_of(source_path)
    more = {"native": native, "rule": rule}
    if kind == BLENDER:
        refuse_rule(rule, Path(source_path) / "transforms_test.json")
        more = {}  # its cameras have no lens
    info = _READERS[kind](Path(source_path), images, hold_out, start, masks, **more)
    return local(info, world_offset(info) if offset is None else np.asarray(offset, dtype=np.float64))


def getNerfppNorm(cam_infos: Sequence[Any]) -> dict[str, Any]:
    """The size of a set of views: "translate" (3,), minus their mean centre, and "radius", 1.1 times the largest
    distance from it. Any records with R and T will do.

    Training uses `scene.readers.info.scene_extent`, which differs where cameras share a place or stand apart.
    """
    centers = camera_centers(cam_infos)
    middle = centers.mean(axis=0)
    return {"translate": -middle, "radius": 1.1 * float(np.linalg.norm(centers - middle, axis=1).max())}


def readColmapCameras(
    cam_extrinsics: Mapping[int, Image],
    cam_intrinsics: Mapping[int, Camera],
    depths_params: Mapping[str, Mapping[str, float]] | StrPath | None = None,
    images_folder: StrPath | None = None,
    depths_folder: str = "",
    test_cam_names_list: Collection[str] = (),
) -> list[CameraInfo]:
    """The photos of a COLMAP model, as `scene.colmap_loader` reads it, as views in the order of the model.

    depths_params: scale, offset and med_scale by photo name without extension; a photo that is not listed has no depth
    map. depths_folder: folder of the inverse depth maps; "" for none. test_cam_names_list: names of the test views. The
    photos need not exist, unless their lens distorts. 2023's form: (cam_extrinsics, cam_intrinsics, images_folder),
    with names up to the first dot.
    """
    old = images_folder is None
    folder = Path(depths_params if old else images_folder)
    cameras = [colmap_camera(i, cam_intrinsics[i.camera_id], folder / i.name) for i in cam_extrinsics.values()]
    if any(camera.lens for camera in cameras):
        cameras = to_pinholes(cameras)
    if old:
        return [_publish_camera(camera, of_2023=True) for camera in cameras]
    published = []
    for camera in cameras:
        name = os.path.splitext(camera.image_name)[0]
        if depths_folder and (depths_params is None or name in depths_params):
            params = None if depths_params is None else depths_params[name]
            camera = with_map(camera, os.path.join(depths_folder, f"{name}.png"), params, COLMAP_UNIT)
        published.append(_publish_camera(camera, camera.image_name in test_cam_names_list))
    return published


def readColmapSceneInfo(
    path: StrPath,
    images: str | None = None,
    depths: str | bool | None = None,
    eval: bool | int = False,
    train_test_exp: bool | None = None,
    llffhold: int = HOLD,
) -> SceneInfo:
    """Read a COLMAP scene: photos in the folder `images` (None: "images"), inverse depth maps in `depths` ("": none).

    eval: hold out every llffhold-th view by name, or with llffhold 0 those that sparse/0/test.txt names, one a line.
    train_test_exp: test views are training views, too. 2023's form: (path, images, eval, llffhold=8), known by the
    missing depths and train_test_exp; its names end before the first dot, and decide the order. The field `image` of
    that release stays empty.
    """
    old = isinstance(depths, bool) or (depths is None and train_test_exp is None)
    if isinstance(depths, bool):
        depths, eval, llffhold = "", depths, llffhold if isinstance(eval, bool) else eval
    info = read_colmap(Path(path), images or "images", hold_out=False)
    views = [_publish_camera(view, of_2023=old) for view in info.train_cameras]
    if old:
        views.sort(key=lambda view: view.image_name)
    tests = _choose_test_views(views, Path(path), llffhold) if eval else set()
    views = [replace(view, is_test=index in tests) for index, view in enumerate(views)]
    train = [view for view in views if train_test_exp or not view.is_test]
    return _publish_scene(info, train, [view for view in views if view.is_test], Path(path), depths)


def readCamerasFromTransforms(
    path: StrPath,
    transformsfile: str,
    depths_folder: str | bool = "",
    white_background: bool | str = False,
    is_test: bool = False,
    extension: str = ".png",
) -> list[CameraInfo]:
    """The views of one camera file of a Blender scene, in its order.

    depths_folder: folder of the inverse depth maps; "" for none. white_background has no effect: photos are composited
    when they are used. extension: of photos that the file names without one; others are looked for, too.
    2023's form: (path, transformsfile, white_background, extension=".png").
    """
    if isinstance(depths_folder, bool):
        extension = white_background if isinstance(white_background, str) else extension
        depths_folder = ""
    cameras = []
    for camera in read_frames(Path(path) / transformsfile, suffixes=(extension, *SUFFIXES)):
        if depths_folder:
            camera = with_map(camera, os.path.join(depths_folder, f"{camera.image_name}.png"), None, BLENDER_UNIT)
        cameras.append(_publish_camera(camera, is_test))
    return cameras


def readNerfSyntheticInfo(
    path: StrPath,
    white_background: bool = False,
    depths: str | bool = "",
    eval: bool | str = False,
    extension: str = ".png",
) -> SceneInfo:
    """Read a Blender scene; without eval the test views are training views. depths: as for `readColmapSceneInfo`.

    white_background and extension: as for `readCamerasFromTransforms`. 2023's form: (path, white_background, eval,
    extension=".png").
    """
    if isinstance(depths, bool):
        extension = eval if isinstance(eval, str) else extension
        depths, eval = "", depths
    suffixes = (extension, *SUFFIXES)
    info = read_blender(Path(path), "", hold_out=bool(eval), suffixes=suffixes)
    train = info.train_cameras
    if not eval:  # the reference marks them in either case
        files = {view.image_path for view in read_frames(Path(path) / "transforms_train.json", suffixes=suffixes)}
        train = [replace(view, is_test=view.image_path not in files) for view in train]
    return _publish_scene(info, train, info.test_cameras, Path(path), depths)


def readNerfstudioInfo(
    path: StrPath, white_background: bool = False, depths: str = "", eval: bool = False
) -> SceneInfo:
    """Read a nerfstudio scene, which the reference does not know; arguments as for `readNerfSyntheticInfo`."""
    info = read_nerfstudio(Path(path), "", eval)
    return _publish_scene(info, info.train_cameras, info.test_cameras, Path(path), depths)


def _publish_camera(camera: CameraInfo, is_test: bool | None = None, of_2023: bool = False) -> CameraInfo:
    """The view with its path as a string, perhaps marked as a test view or not, and perhaps by 2023's shorter name."""
    name = os.path.basename(camera.image_name).split(".")[0] if of_2023 else camera.image_name
    is_test = camera.is_test if is_test is None else is_test
    return replace(camera, image_path=str(camera.image_path), image_name=name, is_test=is_test)


def _choose_test_views(views: Sequence[CameraInfo], folder: Path, hold: int) -> set[int]:
    """Indexes of the views to hold out."""
    if hold:
        tests = set(range(0, len(views), hold))
    else:
        listed = folder / "sparse" / "0" / "test.txt"
        try:
            names = set(plain_text(listed).splitlines())
        except (OSError, UnicodeDecodeError) as error:
            raise UserError(
                f"cannot read the names of the test photos in {listed} ({error}); write them there, one a line, or "
                "give an llffhold above 0"
            ) from error
        tests = {index for index, view in enumerate(views) if view.image_name in names}
    if len(tests) == len(views):
        raise UserError(f"all {len(views)} photos of {folder} would be test photos; hold out fewer, or leave eval out")
    return tests


def _publish_scene(
    info: SceneInfo, train: list[CameraInfo], test: list[CameraInfo], folder: Path, depths: str | None
) -> SceneInfo:
    """The scene with these views, depth maps, the size of the training views, and its points as a PLY.

    The reference writes a missing PLY beside the dataset; here it goes to the user's cache folder.
    """
    ply = info.ply_path
    if ply is None:
        points, colors = info.point_cloud.points, np.round(info.point_cloud.colors * 255).astype(np.uint8)
        name = hashlib.sha256(points.tobytes() + colors.tobytes()).hexdigest()[:16]
        ply = cache_folder() / "points" / f"{name}.ply"
        if not ply.is_file():
            write_point_cloud(ply, points, colors)
    cloud = fetchPly(ply)
    train, test = ([_publish_camera(view) for view in views] for views in (train, test))
    size = normalization(train, cloud.points)
    info = SceneInfo(cloud, train, test, size, str(ply), info.is_nerf_synthetic)
    return with_depth_maps(info, folder, depths) if depths else info


# For other code to call, or to replace: Scene then calls what stands here in place of our readers.
sceneLoadTypeCallbacks: dict[str, Callable[..., SceneInfo]] = {
    COLMAP: readColmapSceneInfo,
    BLENDER: readNerfSyntheticInfo,
    NERFSTUDIO: readNerfstudioInfo,
}
_OURS = dict(sceneLoadTypeCallbacks)


def find_reader_replacement(kind: str) -> Callable[..., Any] | None:
    """Find other code's reader for a kind of folder in `sceneLoadTypeCallbacks`; None if ours is there."""
    read = sceneLoadTypeCallbacks.get(kind)
    return None if read is _OURS.get(kind) else read


def read_scene_by(read: Callable[..., Any], kind: str, args: argparse.Namespace) -> SceneInfo:
    """Read the scene by other code's reader, called with the reference's arguments.

    The reader may return any record with the fields that a release of the reference has. kind: the scene folder's.
    """
    depths = getattr(args, "depths", None) or ""
    if kind == COLMAP:
        info = read(str(args.source_path), args.images, depths, args.eval, getattr(args, "train_test_exp", False))
    else:
        info = read(str(args.source_path), args.white_background, depths, args.eval)
    if isinstance(info, SceneInfo):
        return info
    values = {name: getattr(info, name) for name in SceneInfo._fields if hasattr(info, name)}
    return SceneInfo(**{"is_nerf_synthetic": kind == BLENDER, **values})  # unknown to the release of 2023
