"""COLMAP models through pycolmap, as plain records. The one module that imports pycolmap."""

import signal
import threading
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np

# Pillow's zlib must be in the process before pycolmap's, or writing a PNG aborts (pycolmap 4.2.1, Pillow 13.0).
from PIL import Image  # noqa: F401

from utils.system_utils import UserError


class ColmapView(NamedTuple):
    """A registered picture: COLMAP's name, camera, intrinsics in pixels, world-to-camera rotation (3,3), shift (3,)."""

    name: str
    camera_id: int
    camera_model: str
    params: tuple[float, ...]
    width: int
    height: int
    rotation: np.ndarray
    translation: np.ndarray


class ColmapModel(NamedTuple):
    """Views in the order of their image ids; points (N,3) float64 and colours (N,3) uint8 in the order of theirs."""

    views: list[ColmapView]
    points: np.ndarray
    colors: np.ndarray


def find_model(scene: Path) -> Path:
    """Folder of the COLMAP model, `sparse/0` or `sparse`. UserError that says what is there instead."""
    candidates = (scene / "sparse" / "0", scene / "sparse")
    for folder in candidates:
        if any(_has_model(folder, suffix) for suffix in ("bin", "txt")):
            return folder
    found = sorted(str(path.relative_to(scene)) for path in (scene / "sparse").glob("**/*"))[:8]
    raise UserError(
        f"no COLMAP model in {candidates[0]} or {candidates[1]}: looked for cameras, images and points3D as .bin or "
        f".txt, found {', '.join(found) or 'nothing'}; copy the whole model there"
    )


def read_model(folder: Path) -> ColmapModel:
    """Read a model, binary or (where that is missing or broken) text. UserError when neither can be read."""
    pycolmap = _pycolmap()
    errors = []
    for suffix, read in (("bin", "read_binary"), ("txt", "read_text")):
        if not _has_model(folder, suffix):
            continue
        model = pycolmap.Reconstruction()
        try:
            getattr(model, read)(str(folder))
            if suffix == "bin":
                _check_cameras_whole(folder / "cameras.bin", model)
        except (ValueError, RuntimeError, IndexError, MemoryError) as error:
            errors.append(f".{suffix}: {str(error).splitlines()[0] if str(error) else type(error).__name__}")
            continue
        return _records(model)
    raise UserError(f"cannot read the COLMAP model in {folder} ({'; '.join(errors)}); export it again from COLMAP")


def _pycolmap() -> ModuleType:
    # Late: importing pycolmap takes time and loads libraries that a Blender scene does not need.
    import pycolmap

    # It lets glog answer SIGTERM with a stack dump. Python does not see that, so its own idea brings back what was.
    handler = signal.getsignal(signal.SIGTERM)
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)
    return pycolmap


def points_file(folder: Path) -> Path:
    """The file that holds the model's points."""
    return next(path for path in (folder / "points3D.bin", folder / "points3D.txt") if path.is_file())


def _has_model(folder: Path, suffix: str) -> bool:
    return all((folder / f"{name}.{suffix}").is_file() for name in ("cameras", "images", "points3D"))


def _check_cameras_whole(path: Path, model) -> None:
    # pycolmap 4.2.1 fills the missing end of this file with garbage instead of refusing it.
    wanted = 8 + sum(24 + 8 * len(camera.params) for camera in model.cameras.values())
    if path.stat().st_size < wanted:
        raise ValueError(f"cameras.bin is cut short, {path.stat().st_size} of {wanted} bytes")


def _records(model) -> ColmapModel:
    views = []
    for image_id in sorted(model.reg_image_ids()):
        image = model.images[image_id]
        camera = model.cameras[image.camera_id]
        pose = image.cam_from_world().matrix()
        views.append(
            ColmapView(
                name=image.name,
                camera_id=image.camera_id,
                camera_model=camera.model_name,
                params=tuple(float(value) for value in camera.params),
                width=int(camera.width),
                height=int(camera.height),
                rotation=pose[:, :3],
                translation=pose[:, 3],
            )
        )
    points = [model.points3D[point_id] for point_id in sorted(model.points3D)]
    return ColmapModel(
        views,
        np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3),
        np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3),
    )
