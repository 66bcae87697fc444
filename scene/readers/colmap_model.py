"""COLMAP models as plain records: through pycolmap, or without it where it is not installed."""

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from scene.pictures.lens import Lens
from scene.pictures.pycolmap_import import has_pycolmap, import_pycolmap
from scene.readers import colmap_binary, colmap_text
from scene.readers.colmap_faults import NAMES, describe
from scene.readers.colmap_lengths import check_lengths
from scene.readers.colmap_records import qvec2rotmat
from utils.system_utils import UserError


class ColmapView(NamedTuple):
    """A registered photo: COLMAP's name, camera id and lens, world-to-camera rotation (3,3) and translation (3,)."""

    name: str
    camera_id: int
    lens: Lens
    rotation: np.ndarray
    translation: np.ndarray


class ColmapModel(NamedTuple):
    """Views in the order of their image ids; points (N,3) float64 and colours (N,3) uint8 in the order of point ids."""

    views: list[ColmapView]
    points: np.ndarray
    colors: np.ndarray


def find_model(scene: Path) -> tuple[Path, ColmapModel]:
    """Folder and contents of the COLMAP model with the most registered photos, in `sparse` or one of its sub-folders.

    Among equals `sparse/0` comes first, then `sparse`. A message says which of several models is used. UserError saying
    what was found when there is no model, or none that can be read.
    """
    sparse = scene / "sparse"
    inside = sorted(path for path in sparse.iterdir() if path.is_dir())
    folders = list(dict.fromkeys([sparse / "0", sparse, *inside]))
    folders = [folder for folder in folders if any(_has_model(folder, suffix) for suffix in ("bin", "txt"))]
    if not folders:
        found = sorted(str(path.relative_to(scene)) for path in sparse.glob("**/*"))[:8]
        raise UserError(
            f"no COLMAP model in {sparse / '0'}, {sparse} or its other folders: looked for cameras, images and "
            f"points3D as .bin or .txt, found {', '.join(found) or 'nothing'}; copy the whole model there"
        )
    models, errors = {}, []
    for folder in folders:
        try:
            models[folder] = read_model(folder)
        except UserError as error:
            errors.append(error)
    if not models:
        raise errors[0]
    for error in errors:
        print(f"{error}; another model is used", file=sys.stderr)
    best = max(models, key=lambda folder: len(models[folder].views))  # the first among equals
    if len(models) > 1:
        others = ", ".join(f"{folder} {len(models[folder].views)}" for folder in models if folder != best)
        print(f"{best} registers {len(models[best].views)} photos and is used; {others}", file=sys.stderr)
    return best, models[best]


def read_model(folder: Path) -> ColmapModel:
    """Read a binary model, or a text model if that is missing or broken. UserError when neither can be read."""
    if not has_pycolmap():
        return _read_plainly(folder)
    pycolmap = import_pycolmap()
    errors = []
    for suffix, read in (("bin", "read_binary"), ("txt", "read_text")):
        if not _has_model(folder, suffix):
            continue
        model = pycolmap.Reconstruction()
        try:
            if suffix == "bin":
                check_lengths(folder)
            getattr(model, read)(str(folder))
            return _records(model, {} if suffix == "bin" else _spaced_names(folder / "images.txt", model))
        except UnicodeDecodeError:
            errors.append(f".{suffix}: photo names are not UTF-8 (rename the photos in plain letters)")
        except (ValueError, RuntimeError, LookupError, MemoryError) as error:
            errors.append(describe(folder, suffix, error))
    raise _unreadable(folder, errors)


def _unreadable(folder: Path, faults: list[str]) -> UserError:
    return UserError(
        f"cannot read the COLMAP model in {folder} ({'; '.join(faults)}); fix that, or copy all three files again "
        "from where they were made"
    )


def _read_plainly(folder: Path) -> ColmapModel:
    if _has_model(folder, "bin"):
        cameras = colmap_binary.read_intrinsics_binary(folder / "cameras.bin")
        images = colmap_binary.read_extrinsics_binary(folder / "images.bin")
        rows = colmap_binary.read_point_rows_binary(folder / "points3D.bin")
    else:
        cameras = colmap_text.read_intrinsics_text(folder / "cameras.txt")
        images = colmap_text.read_extrinsics_text(folder / "images.txt")
        rows = colmap_text.read_point_rows_text(folder / "points3D.txt")
    views = []
    for _, image in sorted(images.items()):
        camera = cameras.get(image.camera_id)
        length = float(np.linalg.norm(image.qvec))
        if camera is None or not (length > 0 and np.isfinite([*image.qvec, *image.tvec]).all()):
            what = f"no camera {image.camera_id}" if camera is None else "no rotation and translation"
            raise _unreadable(folder, [f"the photo {image.name} has {what}"])
        lens = Lens(camera.model, tuple(camera.params.tolist()), camera.width, camera.height)
        rotation = qvec2rotmat(image.qvec / length)
        views.append(ColmapView(image.name, image.camera_id, lens, rotation, image.tvec))
    table = np.array([values for _, *values, _ in sorted(rows)], dtype=np.float64).reshape(-1, 6)
    return ColmapModel(views, table[:, :3].copy(), table[:, 3:].astype(np.uint8))


class Sightings(NamedTuple):
    """Points seen in a registered photo: their pixels (n,2) of width x height, centres at .5, and depths z (n,)."""

    name: str
    width: int
    height: int
    pixels: np.ndarray
    depths: np.ndarray


def read_sightings(folder: Path, suffix: str) -> list[Sightings]:
    """Sightings of all registered photos of a model in .bin or .txt files. UserError when it cannot be read."""
    if not _has_model(folder, suffix):
        raise UserError(f"no COLMAP model in {folder} as .{suffix}; choose the other kind with --model_type")
    model = import_pycolmap().Reconstruction()
    try:
        if suffix == "bin":
            check_lengths(folder)
        (model.read_binary if suffix == "bin" else model.read_text)(str(folder))
    except (ValueError, RuntimeError, IndexError, MemoryError) as error:
        raise _unreadable(folder, [describe(folder, suffix, error)]) from error
    sightings = []
    for image_id in sorted(model.reg_image_ids()):
        image = model.images[image_id]
        camera = model.cameras[image.camera_id]
        seen = [point for point in image.points2D if point.has_point3D()]
        points = np.array([model.points3D[point.point3D_id].xyz for point in seen], dtype=np.float64).reshape(-1, 3)
        pose = image.cam_from_world().matrix()
        sightings.append(
            Sightings(
                name=image.name,
                width=int(camera.width),
                height=int(camera.height),
                pixels=np.array([point.xy for point in seen], dtype=np.float64).reshape(-1, 2),
                depths=points @ pose[2, :3] + pose[2, 3],
            )
        )
    return sightings


def points_file(folder: Path) -> Path:
    """The file that holds the model's points."""
    return next(path for path in (folder / "points3D.bin", folder / "points3D.txt") if path.is_file())


def _has_model(folder: Path, suffix: str) -> bool:
    return all((folder / f"{name}.{suffix}").is_file() for name in NAMES)


def _spaced_names(path: Path, model) -> dict[int, str]:
    """Names with spaces in an images.txt, by image id: the format allows them, but pycolmap 4.2.1 cuts them off."""
    names = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        fields = line.split(maxsplit=9)  # id, quaternion, translation, camera id, name; or else 2D points
        if len(fields) == 10 and " " in fields[9].rstrip() and fields[0].isdigit():
            image_id = int(fields[0])
            if image_id in model.images and model.images[image_id].name == fields[9].split()[0]:
                names[image_id] = fields[9].rstrip()
    return names


def _records(model, spaced_names: dict[int, str]) -> ColmapModel:
    views = []
    for image_id in sorted(model.reg_image_ids()):
        image = model.images[image_id]
        camera = model.cameras[image.camera_id]
        pose = image.cam_from_world().matrix()
        views.append(
            ColmapView(
                name=spaced_names.get(image_id, image.name),
                camera_id=image.camera_id,
                lens=Lens(
                    camera.model_name,
                    tuple(float(value) for value in camera.params),
                    int(camera.width),
                    int(camera.height),
                ),
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
