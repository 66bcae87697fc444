"""Depth maps that supervise training: their files, units and decoding.

Maps of inverse depth are grey images. Metric maps, of distances along the axis of the view, or from the camera for
fisheyes and panoramas, are .npy and .pfm files of metres, and 16-bit PNGs beside a file METRIC, which tells metres.
"""

import json
import os
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from groundwork.files.image_files import UNREADABLE, open_image, plane_scale
from groundwork.files.plain_files import plain_path, plain_text
from groundwork.host.listing import some
from groundwork.host.machine import threads
from scene.images.decode import picture_size
from scene.images.find import SideFiles, files_below
from scene.readers.colmap import find_model
from scene.readers.info import CameraInfo, SceneInfo
from scene.readers.photos import undistorted_folder
from utils.system_utils import UserError

PARAMS = "depth_params.json"
METRIC = "metric.json"  # in the folder of metric maps: STEP and SCALE
STEP, SCALE = "metres_per_step", "units_per_metre"  # of the values of PNGs, and of the scene's coordinates
COLMAP_UNIT = 65536.0  # of a map's values; depth_scale.py divides by 65535; the reference uses both, too
BLENDER_UNIT = 512.0
_FLOATS = ".npy", ".pfm"
NEAREST_PART = 1e-4  # of a map's median distance, which real maps do not reach
LEAST = 1e-12  # world units; distances below it are damaged
SMALLEST = 64  # pixels of a photo for a map's
RELIABLE = 5.0  # largest factor between a trusted scale and the scene's median scale
_MAKE = "python utils/make_depth_scale.py --base_dir {scene} --depths_dir {depths}"


@dataclass(frozen=True)
class DepthMap:
    """Inverse depth of a view, 1 / world units: values of the file / unit * scale + offset.

    metric: 1 / (values / unit) instead, and NaN where a value is not a number above 0, or where one is resampled.
    """

    path: Path
    unit: float
    scale: float = 1.0
    offset: float = 0.0
    metric: bool = False
    pixel_bytes: ClassVar[int] = 4

    def decode(self, size: tuple[int, int]) -> Tensor:
        """Inverse depth (1, H, W) float32 at a size (width, height). UserError for a file that cannot be read."""
        values = read_values(self.path) / self.unit
        return apply_fit(inverses(values) if self.metric else values, size, self.scale, self.offset)

    def has_depth(self) -> bool:
        """Tell whether any value of the file is a depth. UserError for a file that cannot be read."""
        values = read_values(self.path) / self.unit
        return bool((np.isfinite(inverses(values)) if self.metric else values > 0).any())


class Metric(NamedTuple):
    """The units of a folder of metric maps: metres of a PNG's step, and units of the scene for each metre."""

    step: float | None
    scale: float | None

    @classmethod
    def from_folder(cls, folder: Path) -> "Metric | None":
        """Read units from the file METRIC; None for a folder of inverse depth. UserError for a broken file.

        Maps are metric if they are .npy or .pfm in a folder without a PNG, or PNGs beside a file METRIC with their
        step.
        """
        path, suffixes = folder / METRIC, {file.suffix.lower() for file in files_below(folder)}
        try:
            told = json.loads(plain_text(path)) if path.is_file() else {}
            step, scale = (None if told.get(key) is None else float(told[key]) for key in (STEP, SCALE))
            if not all(number is None or 0 < number < np.inf for number in (step, scale)):
                raise ValueError("a number is not above 0")
        except (OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
            raise UserError(f"{path} does not give {STEP} or {SCALE} as a number ({error}); write it again") from error
        has_floats = not suffixes.isdisjoint(_FLOATS) and ".png" not in suffixes
        return cls(step, scale) if has_floats or step is not None else None

    def map_of(self, path: Path) -> DepthMap:
        """The map in a file, in units of the scene."""
        step = self.step if path.suffix.lower() == ".png" else 1.0
        return DepthMap(path, 1 / (step * (self.scale or 1.0)), metric=True)


def map_names(metric: Metric | None) -> Callable[[str], list[str]]:
    """File names of a map for a photo's name: with the map's suffix in place of the photo's, or behind it."""
    suffixes = (*([".png"] if metric is None or metric.step is not None else []), *(_FLOATS if metric else ()))
    return lambda name: [base + suffix for base in (os.path.splitext(name)[0], name) for suffix in suffixes]


def inverses(distances: np.ndarray) -> np.ndarray:
    """1 / distances, and NaN where a distance is not a number above 0.

    NaN also below NEAREST_PART of the median distance, as one such pixel would outweigh all others.
    """
    sound = np.isfinite(distances) & (distances > LEAST)
    if sound.any():
        sound &= distances >= NEAREST_PART * np.median(distances[sound])
    return np.where(sound, 1 / np.where(sound, distances, 1.0), np.nan)


class DepthFit(NamedTuple):
    """Inverse depth = value * scale + offset, and whether to train on it."""

    scale: float = 1.0
    offset: float = 0.0
    reliable: bool = True


def depth_fit(params: Mapping[str, float] | None) -> DepthFit:
    """The fit that `scale`, `offset` and the scene's median scale `med_scale` tell; None: the map is used as it is.

    A scale that is not positive belongs to a fit that failed: it is not applied, and the map is not reliable. Nor is a
    map whose scale is far from the median. Without `med_scale` the scale is the median.
    """
    if params is None:
        return DepthFit()
    scale = params["scale"]
    median = params.get("med_scale", scale)
    if scale <= 0:
        return DepthFit(reliable=False)
    return DepthFit(scale, params["offset"], median / RELIABLE <= scale <= median * RELIABLE)


def with_depth_maps(info: SceneInfo, scene: Path, depths: str) -> SceneInfo:
    """The scene with a DepthMap for each training view that has a reliable one; a message names the others.

    depths: folder of the maps under the scene folder. UserError when it, a map or depth_params.json is missing.
    """
    folder = scene / depths
    if not folder.is_dir():
        raise UserError(
            f"no folder of depth maps {folder}; name it with -d relative to the scene folder, or leave -d out"
        )
    undistorted = [c.image_name for c in info.train_cameras if Path(c.image_path).is_relative_to(undistorted_folder())]
    if undistorted:
        raise UserError(
            f"-d needs photos without distortion: {len(undistorted)} photos are undistorted on load, while their depth "
            f"maps are not ({some(undistorted)}); undistort the scene with `colmap image_undistorter`, and make "
            "maps of the undistorted photos"
        )
    metric, is_colmap = Metric.from_folder(folder), (scene / "sparse").is_dir()
    files = _index_depth_files(info.train_cameras, scene, folder, is_colmap)
    paths = [files.find(place, map_names(metric)) for place in range(len(info.train_cameras))]
    files.report_elsewhere("depth maps")
    if metric:
        cameras = _add_metric_maps(info.train_cameras, paths, scene, folder, metric)
    else:
        # A map that is missing is named as it should be called.
        paths = [
            path or folder / f"{os.path.splitext(name)[0]}.png" for path, name in zip(paths, files.names, strict=True)
        ]
        if is_colmap:
            cameras = _add_colmap_maps(info.train_cameras, paths, scene, folder)
        else:
            pairs = zip(info.train_cameras, paths, strict=True)
            # Inverse depth that render.py has written tells its unit.
            cameras = [
                with_map(camera, path, None, 1 / (plane_scale(path) or 1 / BLENDER_UNIT)) for camera, path in pairs
            ]
    _check_files([camera for camera in cameras if camera.depth])
    return replace(info, train_cameras=_drop_empty_maps(cameras, folder))


def _index_depth_files(cameras: Sequence[CameraInfo], scene: Path, folder: Path, is_colmap: bool) -> SideFiles:
    """Prepare the search for the depth maps of views below `folder`, by the names of their photos.

    Names are those of COLMAP's model (is_colmap), or paths of the photos from the folder `scene`.
    """
    photos = [Path(camera.lying or camera.image_path) for camera in cameras]
    names = [
        camera.image_name if is_colmap or not camera.image_path else os.path.relpath(photo, scene)
        for camera, photo in zip(cameras, photos, strict=True)
    ]
    return SideFiles(folder, names, photos, scene)


def _drop_empty_maps(cameras: list[CameraInfo], folder: Path) -> list[CameraInfo]:
    """Remove maps without any depth from the views; a message names them. UserError if all are such."""
    views = [camera for camera in cameras if camera.depth]
    with ThreadPoolExecutor(threads()) as pool:
        told = pool.map(lambda view: view.depth.has_depth(), views)
        empty = [view for view, has_depth in zip(views, told, strict=True) if not has_depth]
    if not empty:
        return cameras
    said = f"{len(empty)} of {len(views)} depth maps in {folder} have no pixel with a depth above 0"
    if len(empty) == len(views):
        raise UserError(f"{said} ({some([str(view.depth.path) for view in empty])}); make them again, or leave -d out")
    print(f"{said} and are left out: {some([view.image_name for view in empty])}", file=sys.stderr)
    left = set(map(id, empty))
    return [
        replace(view, depth=None, depth_path="", depth_params=None) if id(view) in left else view for view in cameras
    ]


def with_map(camera: CameraInfo, path: str | Path, params: Mapping[str, float] | None, unit: float) -> CameraInfo:
    """The view with a depth map's file and parameters, and with the map itself if its scale is reliable.

    unit: COLMAP_UNIT or BLENDER_UNIT. A map without parameters is taken as it is, as in the reference.
    """
    fit = depth_fit(params)
    depth = DepthMap(Path(path), unit, fit.scale, fit.offset) if fit.reliable else None
    return replace(camera, depth_path=str(path), depth_params=params, depth=depth)


def read_values(path: Path) -> np.ndarray:
    """Values (H, W) float64 of a .npy, a .pfm or a grey image file of 8 or 16 bits, unscaled. UserError for others."""
    try:
        if path.suffix.lower() == ".npy":
            return _open_array(path).astype(np.float64)
        with open_image(path) as image:
            if path.suffix.lower() == ".pfm":
                return np.asarray(image, dtype=np.float64)
            if image.mode not in ("L", "I;16", "I;16B", "I"):
                if _is_16_bit_color(path):
                    raise UserError(
                        f"the depth map {path} has 16-bit colours, which are read as 8 bits; save it as grey"
                    )
                image = image.convert("RGB")
            values = np.asarray(image)
    except (*UNREADABLE, MemoryError) as error:
        raise _make_read_error(path, error) from error
    if values.ndim == 3:
        # Some tools write grey as three equal channels.
        if (values != values[..., :1]).any():
            raise UserError(f"the depth map {path} is coloured; save inverse depth as grey, best with 16 bits")
        values = values[..., 0]
    return values.astype(np.float64)


def _open_array(path: Path) -> np.ndarray:
    """The floats (H, W) of a .npy, which stay in the file. ValueError for other arrays."""
    values = np.load(plain_path(path), mmap_mode="r", allow_pickle=False)
    if not isinstance(values, np.ndarray) or values.ndim != 2 or values.dtype.kind != "f":
        raise ValueError("it is no array (height, width) of floats")
    return values


def map_size(path: Path) -> tuple[int, int]:
    """Size (width, height) of a map, from its file's header. UserError where that tells of a broken file."""
    if path.suffix.lower() not in _FLOATS:
        return picture_size(path)
    try:
        if path.suffix.lower() == ".npy":
            return _open_array(path).shape[::-1]
        with open_image(path) as image:
            if path.stat().st_size < image.tile[0][2] + 4 * image.width * image.height:
                raise ValueError("it ends too early")
            return image.size
    except (*UNREADABLE, MemoryError) as error:
        raise _make_read_error(path, error) from error


def _make_read_error(path: Path, error: Exception) -> UserError:
    return UserError(f"cannot read the depth map {path} ({str(error) or type(error).__name__}); make it again")


def _is_16_bit_color(path: Path) -> bool:
    # Pillow silently drops the lower 8 bits. Byte 24 of a PNG is the bit depth, byte 25 the colour type.
    with open(path, "rb") as file:
        header = file.read(26)
    return header.startswith(b"\x89PNG") and len(header) == 26 and header[24] == 16 and header[25] in (2, 6)


def apply_fit(values: np.ndarray, size: tuple[int, int], scale: float, offset: float) -> Tensor:
    """Inverse depth (1, H, W) float32 at a size (width, height) of a map's values (h, w); those below 0 count as 0."""
    values = np.maximum(resize(values, size), 0.0) * scale + offset
    return torch.from_numpy(values.astype(np.float32))[None]


def resize(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(h, w) resampled to size (width, height): bilinear between four pixel centres, not antialiased."""
    if values.shape == size[::-1]:
        return values
    y, x = ((np.arange(new) + 0.5) * old / new - 0.5 for new, old in zip(size[::-1], values.shape, strict=True))
    return sample(values, *np.meshgrid(x, y))


def sample(values: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Bilinear values of (h, w) at columns x and rows y, pixel centres at integers; outside, the border's values."""
    from scipy.ndimage import map_coordinates  # takes time to load, and most trainings have no depth maps

    return map_coordinates(values, [y, x], order=1, mode="nearest")


def _add_colmap_maps(
    cameras: Sequence[CameraInfo], paths: Sequence[Path], scene: Path, folder: Path
) -> list[CameraInfo]:
    """Add the maps, `paths` in the order of the views, with the scales of depth_params.json.

    A message names views without a reliable scale, which get no map. UserError if all are such.
    """
    path = find_model(scene)[0] / PARAMS
    make = _MAKE.format(scene=scene, depths=folder)
    if not path.is_file():
        raise UserError(f"no {path}, which depth maps need; create it with `{make}`")
    table = _read_params(path, make)
    found = []
    unknown, unreliable = [], []
    for camera, map_path in zip(cameras, paths, strict=True):
        name = Path(camera.image_name).with_suffix("").as_posix()
        named = with_map(camera, map_path, table[name], COLMAP_UNIT) if name in table else camera
        if not named.depth:
            (unreliable if name in table else unknown).append(camera.image_name)
        found.append(named if named.depth else camera)
    reasons = [
        f"{len(names)} {what} ({some(names)})"
        for names, what in ((unknown, f"not in {path}"), (unreliable, "with an unreliable scale there"))
        if names
    ]
    left_out = f"{len(unknown) + len(unreliable)} of {len(cameras)} training photos have no depth loss: "
    left_out += ", ".join(reasons)
    if len(unknown) + len(unreliable) == len(cameras):
        raise UserError(f"{left_out}; create the file again with `{make}`, or leave -d out")
    if reasons:
        print(left_out, file=sys.stderr)
    return found


def _add_metric_maps(
    cameras: Sequence[CameraInfo], paths: Sequence[Path | None], scene: Path, folder: Path, metric: Metric
) -> list[CameraInfo]:
    """Add the metric maps, `paths` in the order of the views, None for a view without one.

    A message names views without a map. UserError for a map of another shape than its photo.
    """
    is_colmap, found = (scene / "sparse").is_dir(), []
    if is_colmap and metric.scale is None:
        make = _MAKE.format(scene=scene, depths=folder)
        raise UserError(f"no {SCALE} in {folder / METRIC}, which metric maps need; create it with `{make}`")
    for camera, path in zip(cameras, paths, strict=True):
        depth = metric.map_of(path) if path else None
        found.append(replace(camera, depth_path=str(depth.path), depth=depth) if depth else camera)
        width, height = map_size(depth.path) if depth else (camera.width, camera.height)
        if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height):
            raise UserError(
                f"the depth map {depth.path} has {width} x {height} pixels, but its photo has another aspect ratio, "
                f"{camera.width} x {camera.height}; compute it from the whole photo"
            )
    lacking = [camera.image_name for camera in found if not camera.depth]
    if len(lacking) == len(found):
        raise UserError(f"no depth map in {folder} is named like a training photo; rename the maps, or leave -d out")
    if lacking:
        print(f"{len(lacking)} of {len(found)} training photos have no depth map ({some(lacking)})", file=sys.stderr)
    return found


def _read_params(path: Path, make: str) -> dict[str, dict[str, float]]:
    """Parameters as in `CameraInfo.depth_params`, by photo name without extension."""
    try:
        table = json.loads(plain_text(path))
        params = {name: {key: float(entry[key]) for key in ("scale", "offset")} for name, entry in table.items()}
        if not np.isfinite([list(entry.values()) for entry in params.values()]).all():
            raise ValueError("a number is not finite")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise UserError(
            f"{path} does not give a scale and an offset for every photo ({type(error).__name__}: {error}); create it "
            f"again with `{make}`"
        ) from error
    scales = [entry["scale"] for entry in params.values() if entry["scale"] > 0]
    median = float(np.median(scales)) if scales else 0.0
    return {name: {**entry, "med_scale": median} for name, entry in params.items()}


def _check_files(cameras: Sequence[CameraInfo]) -> None:
    """Raise a UserError for maps that are missing, shared by several views, or much smaller than the photos."""
    paths = [camera.depth.path for camera in cameras]
    missing = [str(path) for path in paths if not path.is_file()]
    if missing:
        raise UserError(
            f"{len(missing)} of {len(paths)} depth maps are missing: {some(missing)}; put them there, or leave -d out"
        )
    shared = [str(path) for path, count in Counter(paths).items() if count > 1]
    if shared:
        raise UserError(
            f"several training photos have the same depth map: {some(shared)}; put a map for each into the folder, in "
            "the sub-folders of the photos (with COLMAP, give photos names that differ by more than the suffix)"
        )
    for camera, (width, height) in zip(cameras, map(map_size, paths), strict=True):
        if min(width, height) < 2 or width * SMALLEST < camera.width or height * SMALLEST < camera.height:
            raise UserError(
                f"the depth map {camera.depth.path} has only {width} x {height} pixels, and its photo {camera.width} x "
                f"{camera.height}; compute it at a higher resolution"
            )
