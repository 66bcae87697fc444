"""Readers with the reference's names and arguments, for code that calls them itself.

Each takes the arguments of the October 2024 release, and those of the 2023 release where it can tell them apart. They
compose the readers that training uses (colmap.py, transforms.py) and write nothing into the dataset. Coordinates are
the world's, even far from its origin. Paths in the records are strings. Errors that the user can fix are UserErrors.
"""

import hashlib
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from scene.images.lens import Lens, pinhole_of
from scene.readers.colmap import read_colmap
from scene.readers.colmap_records import Camera, Image, qvec2rotmat
from scene.readers.depth_maps import BLENDER_UNIT, COLMAP_UNIT, named_depth_map, with_depth_maps
from scene.readers.info import HOLD, CameraInfo, SceneInfo, camera_centers, normalization
from scene.readers.point_cloud import fetchPly, write_point_cloud
from scene.readers.source_views import SourceView, camera_of, make_cameras
from scene.readers.transforms import read_blender, read_frames, read_nerfstudio
from splatting.files.image_files import SUFFIXES
from splatting.files.plain_files import plain_text
from splatting.host.cache_folder import cache_folder
from utils.system_utils import UserError

StrPath = str | os.PathLike


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
    views = []
    for image in cam_extrinsics.values():
        camera = cam_intrinsics[image.camera_id]
        lens = Lens(camera.model, tuple(float(value) for value in camera.params), camera.width, camera.height)
        tvec = np.asarray(image.tvec, dtype=np.float64)
        views.append(SourceView(image.name, folder / image.name, camera.id, lens, qvec2rotmat(image.qvec), tvec))
    pinholes = [pinhole_of(view.lens, view.name) for view in views]
    if None in pinholes:
        cameras = make_cameras(views, ignore_alpha=False)
    else:
        cameras = [camera_of(view, lens, view.path, None) for view, lens in zip(views, pinholes, strict=True)]
    if old:
        return [_as_in_2023(camera) for camera in cameras]
    return [
        _published(_with_depth(c, depths_params, depths_folder), c.image_name in test_cam_names_list) for c in cameras
    ]


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
    views = info.train_cameras
    if old:
        views = sorted((_as_in_2023(view) for view in views), key=lambda view: view.image_name)
    tests = _test_views(views, Path(path), llffhold) if eval else set()
    views = [_published(view, index in tests) for index, view in enumerate(views)]
    train = [view for view in views if train_test_exp or not view.is_test]
    test = [view for view in views if view.is_test]
    return _with_depths_and_ply(info._replace(train_cameras=train, test_cameras=test), Path(path), depths)


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
            camera = replace(camera, depth_path=os.path.join(depths_folder, f"{camera.image_name}.png"))
            camera = replace(camera, depth=named_depth_map(camera, BLENDER_UNIT))
        cameras.append(_published(camera, is_test))
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
    info = read_blender(Path(path), "", hold_out=True, suffixes=(extension, *SUFFIXES))
    train, test = ([_published(view) for view in views] for views in (info.train_cameras, info.test_cameras))
    if not eval:
        train, test = train + test, []
    return _with_depths_and_ply(info._replace(train_cameras=train, test_cameras=test), Path(path), depths)


def readNerfstudioInfo(
    path: StrPath, white_background: bool = False, depths: str = "", eval: bool = False
) -> SceneInfo:
    """Read a nerfstudio scene, which the reference does not know; arguments as for `readNerfSyntheticInfo`."""
    info = read_nerfstudio(Path(path), "", eval)
    train, test = ([_published(view) for view in views] for views in (info.train_cameras, info.test_cameras))
    return _with_depths_and_ply(info._replace(train_cameras=train, test_cameras=test), Path(path), depths)


def _as_in_2023(camera: CameraInfo) -> CameraInfo:
    return _published(replace(camera, image_name=os.path.basename(camera.image_name).split(".")[0]))


def _published(camera: CameraInfo, is_test: bool | None = None) -> CameraInfo:
    """The view with its path as a string, and perhaps marked as a test view or not."""
    return replace(camera, image_path=str(camera.image_path), is_test=camera.is_test if is_test is None else is_test)


def _with_depth(camera: CameraInfo, params: Mapping[str, Mapping[str, float]] | None, depths_folder: str) -> CameraInfo:
    name = os.path.splitext(camera.image_name)[0]
    if not depths_folder or (params is not None and name not in params):
        return camera
    named = replace(
        camera,
        depth_path=os.path.join(depths_folder, f"{name}.png"),
        depth_params=None if params is None else params[name],
    )
    return replace(named, depth=named_depth_map(named, COLMAP_UNIT))


def _test_views(views: Sequence[CameraInfo], folder: Path, hold: int) -> set[int]:
    """Indexes of the views to hold out."""
    if hold:
        tests = set(range(0, len(views), hold))
    else:
        names = _listed_names(folder / "sparse" / "0" / "test.txt")
        tests = {index for index, view in enumerate(views) if view.image_name in names}
    if len(tests) == len(views):
        raise UserError(f"all {len(views)} photos of {folder} would be test photos; hold out fewer, or leave eval out")
    return tests


def _listed_names(path: Path) -> set[str]:
    try:
        return set(plain_text(path).splitlines())
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(
            f"cannot read the names of the test photos in {path} ({error}); write them there, one a line, or give an "
            "llffhold above 0"
        ) from error


def _with_depths_and_ply(info: SceneInfo, folder: Path, depths: str | None) -> SceneInfo:
    """The scene with depth maps, the size of its training views, and its points as a PLY.

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
    size = normalization(info.train_cameras, cloud.points)
    info = info._replace(point_cloud=cloud, ply_path=str(ply), nerf_normalization=size)
    return with_depth_maps(info, folder, depths) if depths else info
