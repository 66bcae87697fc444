"""Readers of datasets: folders to plain records. Nothing here decodes pictures, uses a GPU or writes a file."""

import json
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scene import colmap_loader
from scene.images import picture_size
from scene.point_cloud import check_finite, read_point_cloud
from utils.graphics_utils import BasicPointCloud, focal2fov, fov2focal
from utils.system_utils import UserError

HOLD = 8  # every 8th picture by name is a test view (Mip-NeRF 360's split)
RANDOM_POINTS = 100_000
RANDOM_HALF_SIZE = 1.3  # the NeRF-synthetic objects lie within this cube
_BLENDER_SUFFIXES = ("", ".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class CameraInfo:
    """One view.

    uid: COLMAP's camera (intrinsics) id, or the frame's index. R (3,3): camera-to-world rotation; T (3,):
    world-to-camera translation. fx, fy, cx, cy in pixels of an image of width x height (pixel centres at .5).
    image_name: COLMAP's full name, or the file's stem. file_size: (width, height) of the file.
    """

    uid: int
    R: np.ndarray
    T: np.ndarray
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    image_path: Path
    image_name: str
    file_size: tuple[int, int]

    @property
    def FovX(self) -> float:
        """Horizontal opening angle in radians of a frustum of the image's width."""
        return focal2fov(self.fx, self.width)

    @property
    def FovY(self) -> float:
        """Vertical opening angle in radians of a frustum of the image's height."""
        return focal2fov(self.fy, self.height)

    @property
    def center(self) -> np.ndarray:
        """Camera centre (3,) in the world."""
        return -self.R @ self.T


@dataclass(frozen=True)
class SceneInfo:
    """A dataset: start cloud (None if not wanted), views, extent E in world units, the PLY of the cloud if any."""

    point_cloud: BasicPointCloud | None
    train_cameras: list[CameraInfo]
    test_cameras: list[CameraInfo]
    extent: float
    ply_path: Path | None


def read_scene(
    source_path: str | os.PathLike, images: str, hold_out: bool, init_pcd_path: str = "", want_cloud: bool = True
) -> SceneInfo:
    """Read the dataset in a folder, whichever kind it is. UserError says what was looked for and what was found.

    images: folder of the pictures (COLMAP only). hold_out: keep a test set apart, else everything trains.
    init_pcd_path: PLY to start from instead of the dataset's own points. want_cloud: without, points are neither read
    nor judged, for a model that is there already.
    """
    folder = Path(source_path)
    if not str(source_path):
        raise UserError("no scene folder given; name it with -s")
    if not folder.is_dir():
        raise UserError(f"no scene folder {folder}; name an existing one with -s")
    if (folder / "sparse").is_dir():
        kind = "Colmap"
    elif (folder / "transforms_train.json").is_file():
        kind = "Blender"
    else:
        found = sorted(path.name for path in folder.iterdir())
        raise UserError(
            f"{folder} is not a scene: looked for the folder sparse (COLMAP) and the file transforms_train.json "
            f"(Blender), found {_some(found)}; give -s the folder that holds one of them"
        )
    return sceneLoadTypeCallbacks[kind](folder, images, hold_out, init_pcd_path, want_cloud)


def readColmapSceneInfo(
    folder: Path, images: str, hold_out: bool, init_pcd_path: str = "", want_cloud: bool = True
) -> SceneInfo:
    """Read a COLMAP scene: `sparse/0` or `sparse`, pictures in `<folder>/<images>`, views sorted by name (bytes)."""
    model_folder = colmap_loader.find_model(folder)
    model = colmap_loader.read_model(model_folder)
    if not model.views:
        raise UserError(f"the COLMAP model in {model_folder} has no registered picture; reconstruct the scene again")
    views = sorted(model.views, key=lambda view: os.fsencode(view.name))
    paths = [folder / images / view.name for view in views]
    _check_present(paths, f"the COLMAP model in {model_folder}", "put them there, or name their folder with -i")
    cameras = [_colmap_camera(view, path) for view, path in zip(views, paths, strict=True)]
    _warn_of_other_shapes(cameras)

    train = [camera for index, camera in enumerate(cameras) if not hold_out or index % HOLD]
    test = [camera for index, camera in enumerate(cameras) if hold_out and index % HOLD == 0]
    if not train:
        raise UserError(f"{folder} has too few pictures for --eval, which takes every {HOLD}th; leave --eval out")

    if not want_cloud:
        return SceneInfo(None, train, test, scene_extent(train), None)
    ply_path = Path(init_pcd_path) if init_pcd_path else _fresh_ply(model_folder)
    if ply_path:
        cloud = read_point_cloud(ply_path)
    else:
        points = model.points.astype(np.float32)
        check_finite(points, colmap_loader.points_file(model_folder))
        cloud = BasicPointCloud(points, model.colors.astype(np.float32) / 255, np.zeros_like(points))
    return SceneInfo(cloud, train, test, scene_extent(train, cloud.points), ply_path)


def readNerfSyntheticInfo(
    folder: Path, images: str, hold_out: bool, init_pcd_path: str = "", want_cloud: bool = True
) -> SceneInfo:
    """Read a Blender scene (transforms_train.json, transforms_test.json), views in the order of the files.

    Without a cloud of its own it starts from grey points spread evenly over a cube.
    """
    train = _blender_cameras(folder, "transforms_train.json")
    test = _blender_cameras(folder, "transforms_test.json")
    if not hold_out:
        train, test = train + test, []
    if not train:
        raise UserError(f"{folder / 'transforms_train.json'} lists no frames; export the scene again")

    if not want_cloud:
        return SceneInfo(None, train, test, scene_extent(train), None)
    own = folder / "points3d.ply"
    ply_path = Path(init_pcd_path) if init_pcd_path else own if own.is_file() else None
    cloud = read_point_cloud(ply_path) if ply_path else _random_cloud()
    return SceneInfo(cloud, train, test, scene_extent(train, cloud.points), ply_path)


sceneLoadTypeCallbacks: dict[str, Callable[[Path, str, bool, str, bool], SceneInfo]] = {
    "Colmap": readColmapSceneInfo,
    "Blender": readNerfSyntheticInfo,
}


def scene_extent(cameras: list[CameraInfo], points: np.ndarray | None = None) -> float:
    """Extent E: 1.1 times the largest distance of a camera from the cameras' mean, in world units.

    Cameras in one place have none; then 1.1 times the median depth of the points (N,3) in front of the first camera,
    or 1 without such points.
    """
    centers = np.array([camera.center for camera in cameras])
    extent = 1.1 * float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    points = np.zeros((0, 3)) if points is None else points
    depths = (points @ cameras[0].R + cameras[0].T)[:, 2]
    depths = depths[depths > 0]
    fallback = 1.1 * float(np.median(depths)) if len(depths) else 1.0
    # Rounding can leave a tiny distance between equal centres.
    return extent if extent > 1e-6 * fallback else fallback


def _colmap_camera(view: colmap_loader.ColmapView, path: Path) -> CameraInfo:
    if view.camera_model == "PINHOLE":
        fx, fy, cx, cy = view.params
    elif view.camera_model == "SIMPLE_PINHOLE":
        fx, cx, cy = view.params
        fy = fx
    else:
        raise UserError(
            f"the picture {view.name} has the camera model {view.camera_model}, only PINHOLE and SIMPLE_PINHOLE can be "
            "used; undistort the scene first with `colmap image_undistorter` or pycolmap.undistort_images"
        )
    if not (np.isfinite([fx, fy, cx, cy]).all() and min(fx, fy, view.width, view.height) > 0):
        raise UserError(
            f"the camera of {view.name} has no usable size or focal length ({view.width} x {view.height}, "
            f"{view.params}); export the model again from COLMAP"
        )
    if not (np.isfinite(view.rotation).all() and np.isfinite(view.translation).all()):
        raise UserError(f"the pose of {view.name} is not finite; remove the picture from the COLMAP model")
    return CameraInfo(
        uid=view.camera_id,
        R=view.rotation.T.copy(),
        T=view.translation,
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        width=view.width,
        height=view.height,
        image_path=path,
        image_name=view.name,
        file_size=picture_size(path),
    )


def _fresh_ply(model_folder: Path) -> Path | None:
    ply = model_folder / "points3D.ply"
    if not ply.is_file():
        return None
    source = colmap_loader.points_file(model_folder)
    if ply.stat().st_mtime >= source.stat().st_mtime:
        return ply
    print(f"{ply} is older than {source.name} and is not used; --init_pcd_path {ply} would use it", file=sys.stderr)
    return None


def _blender_cameras(folder: Path, name: str) -> list[CameraInfo]:
    path = folder / name
    if not path.is_file():
        raise UserError(f"no {name} in {folder}; a Blender scene needs transforms_train.json and transforms_test.json")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        angle = float(content["camera_angle_x"])
        frames = [(str(frame["file_path"]), _world_to_camera(frame["transform_matrix"])) for frame in content["frames"]]
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError, np.linalg.LinAlgError) as error:
        raise UserError(
            f"{path} is not a Blender camera file ({type(error).__name__}: {error}); it needs camera_angle_x and "
            "frames, each with file_path and a 4x4 transform_matrix"
        ) from error
    if not 0 < angle < np.pi:
        raise UserError(f"camera_angle_x in {path} must lie between 0 and pi, got {angle}; give it in radians")
    paths = [_blender_picture(folder, file_path) for file_path, _ in frames]
    _check_present(paths, str(path), "put them there")
    cameras = []
    for index, (image_path, (_, matrix)) in enumerate(zip(paths, frames, strict=True)):
        width, height = picture_size(image_path)
        focal = fov2focal(angle, width)
        cameras.append(
            CameraInfo(
                uid=index,
                R=matrix[:3, :3].T.copy(),
                T=matrix[:3, 3].copy(),
                fx=focal,
                fy=focal,
                cx=width / 2,
                cy=height / 2,
                width=width,
                height=height,
                image_path=image_path,
                image_name=image_path.stem,
                file_size=(width, height),
            )
        )
    return cameras


def _world_to_camera(rows: list[list[float]]) -> np.ndarray:
    """World-to-camera matrix (4,4), y down and z forward, of an OpenGL camera-to-world matrix (y up, z backward)."""
    matrix = np.array(rows, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError(f"transform_matrix must be 4x4 finite numbers, got shape {matrix.shape}")
    matrix[:3, 1:3] *= -1
    return np.linalg.inv(matrix)


def _blender_picture(folder: Path, file_path: str) -> Path:
    candidates = [folder / (file_path + suffix) for suffix in _BLENDER_SUFFIXES]
    return next((path for path in candidates if os.path.isfile(path)), candidates[1])


def _random_cloud() -> BasicPointCloud:
    random = np.random.default_rng(0)
    points = random.uniform(-RANDOM_HALF_SIZE, RANDOM_HALF_SIZE, (RANDOM_POINTS, 3)).astype(np.float32)
    return BasicPointCloud(points, np.full_like(points, 127 / 255), np.zeros_like(points))


def _check_present(paths: list[Path], listed_by: str, remedy: str) -> None:
    # os.path, not Path.is_file: a name that is too long for the system is missing too.
    missing = [str(path) for path in paths if not os.path.isfile(path)]
    if missing:
        raise UserError(
            f"{len(missing)} of {len(paths)} pictures that {listed_by} lists are missing: {_some(missing)}; {remedy}"
        )


def _warn_of_other_shapes(cameras: list[CameraInfo]) -> None:
    others = [c for c in cameras if abs(c.file_size[0] * c.height / c.width - c.file_size[1]) > 1]
    if others:
        first = others[0]
        print(
            f"{len(others)} of {len(cameras)} pictures have another aspect ratio than their COLMAP camera, the first "
            f"is {first.image_name} ({first.file_size[0]} x {first.file_size[1]}, camera {first.width} x "
            f"{first.height}); they will be stretched",
            file=sys.stderr,
        )


def _some(names: list[str], most: int = 5) -> str:
    if not names:
        return "nothing"
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")
