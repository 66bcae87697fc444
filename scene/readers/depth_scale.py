"""Fit of a scene's depth maps to its COLMAP points: scale and offset of each, or one scale of all metric maps."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from diff_gaussian_rasterization.lens import MODELS

from groundwork.host.progress import Bar
from scene.colmap_loader import Camera, Image, Points, qvec2rotmat
from scene.images.find import SideFiles
from scene.readers.colmap import AGAIN, ColmapModel, find_model, read_model_of_kind
from scene.readers.depth_maps import METRIC, PARAMS, SCALE, STEP, Metric, inverses, map_names, read_values, sample
from scene.readers.info import SceneInfo
from scene.readers.tracks import projected
from utils.system_utils import UserError, atomic_write

_WITH_POINTS = "export the model with the 2D points of its photos, or train without depth maps"
_POINTS, _VIEWS = 5000, 16  # that are looked at before a training
_OPPOSITE = -0.1  # rank correlation with what maps should be, below which they are the opposite
UNIT = 65535.0  # of a map's values in the fit
MIN_POINTS = 11
MIN_RANGE = 1e-3  # of the points' inverse depths, 1 / world units


def make_depth_params(scene: Path, depths: Path, model_type: str) -> tuple[dict[str, dict[str, float]], int]:
    """Fit every registered photo that has a map in `depths`, and write depth_params.json into the model's folder.

    model_type: bin or txt. Returns the table and the number of registered photos. The table has `scale` and `offset` by
    photo name without extension, both 0 if there are too few points. UserError when no photo has a map, no map
    can be fitted, or the scene has no COLMAP model.
    """
    folder, model = _read_scene_model(scene, model_type)
    table, most, found = {}, 0, []
    paths = _find_maps(scene, depths, model, None)
    for image, path in _pair_with_bar(model, paths):
        camera = model.cameras[image.camera_id]
        pixels, z = sightings(image, model.points, camera, f"{folder} as .{model_type}")
        name = Path(image.name).with_suffix("").as_posix()
        if path is not None:
            values, z = _sample_map(pixels, z, (camera.width, camera.height), read_values(path) / UNIT)
            found.append((values, z))
            scale, offset = fit_line(values, 1 / z)
            table[name] = {"scale": scale, "offset": offset}
            most = max(most, len(z))
    if not table:
        raise UserError(
            f"no depth map in {depths} belongs to a photo of {folder}; name maps like the photos, with .png"
        )
    check_direction(found, depths)
    if not any(entry["scale"] for entry in table.values()):
        raise UserError(
            f"none of {len(table)} maps in {depths} can be fitted: the photos of {folder} as .{model_type} see {most} "
            f"points at most, and a fit needs {MIN_POINTS} of different depths; {_WITH_POINTS}"
        )
    with atomic_write(folder / PARAMS) as path:
        path.write_text(json.dumps(table, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return table, len(model.images)


def make_metric_scale(scene: Path, depths: Path, metric: Metric, model_type: str) -> tuple[float, float, int, int]:
    """Fit the scale of a scene to metric maps, and write it into METRIC: the median of depth / metres over all points.

    Returns units of the scene for each metre, how far half of the points are from it, as a part of it, and the numbers
    of maps and of registered photos. UserError as above, and for fewer than MIN_POINTS points in all maps.
    """
    folder, model = _read_scene_model(scene, model_type)
    found, paths = [], _find_maps(scene, depths, model, metric)
    for image, path in _pair_with_bar(model, paths):
        if path is not None:
            depth = metric._replace(scale=None).map_of(path)
            camera, values = model.cameras[image.camera_id], inverses(read_values(depth.path) / depth.unit)
            pixels, z = sightings(image, model.points, camera, f"{folder} as .{model_type}")
            found.append(_sample_map(pixels, z, (camera.width, camera.height), values))
    check_direction(found, depths, METRIC)
    ratios = np.concatenate([(values * z)[np.isfinite(values)] for values, z in found]) if found else np.zeros(0)
    if len(ratios) < MIN_POINTS:
        raise UserError(
            f"the maps in {depths} have depths at {len(ratios)} points of {folder}, too few to fit a scale; "
            f"{_WITH_POINTS}"
        )
    scale = float(np.median(ratios))
    told = {STEP: metric.step} if metric.step else {}
    with atomic_write(depths / METRIC) as path:
        path.write_text(json.dumps(told | {SCALE: scale}, indent=2) + "\n", encoding="utf-8")
    return scale, float(np.median(np.abs(ratios / scale - 1))), len(found), len(model.images)


def _find_maps(scene: Path, depths: Path, model: ColmapModel, metric: Metric | None) -> list[Path | None]:
    """The files of the maps of a model's photos, found as training finds them."""
    names = [image.name for image in model.images]
    files = SideFiles(depths, names, [scene / "images" / name for name in names], scene)
    return [files.find(place, map_names(metric)) for place in range(len(names))]


def _pair_with_bar(model: ColmapModel, paths: list[Path | None]) -> Bar:
    return Bar(list(zip(model.images, paths, strict=True)), desc="Fitting depth maps", unit="map")


def _read_scene_model(scene: Path, model_type: str) -> tuple[Path, ColmapModel]:
    """Read the COLMAP model of a scene and return it with its folder. model_type: "bin" or "txt"."""
    if not (scene / "sparse").is_dir():
        raise UserError(
            f"no folder sparse in {scene}: maps are fitted to the points of a COLMAP model; name a COLMAP scene "
            "(--base_dir), or train a Blender scene (transforms_train.json) without a fit"
        )
    folder, _ = find_model(scene)
    return folder, read_model_of_kind(folder, model_type, with_2d_points=True)


def sightings(image: Image, points: Points, camera: Camera, model: str) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n,2), centres at .5, and depths (n,) of the points that a photo sees, of all points sorted by id.

    The depth is z, and of a fisheye or a panorama the distance from the camera, as renders have it. UserError, naming
    the model, for a point that is not among them.
    """
    has_point = image.point3D_ids >= 0
    ids = image.point3D_ids[has_point]
    places = np.searchsorted(points.ids, ids)
    if (places == np.searchsorted(points.ids, ids, side="right")).any():
        raise UserError(f"the photo {image.name} in {model} sees a point that is not in points3D; {AGAIN}")
    turn, shift = qvec2rotmat(image.qvec), image.tvec
    if camera.model in MODELS and MODELS[camera.model][0] != "perspective":
        return image.xys[has_point], np.linalg.norm(points.xyz[places] @ turn.T + shift, axis=1)
    return image.xys[has_point], points.xyz[places] @ turn[2] + shift[2]


def check_maps(info: SceneInfo, depths: Path) -> None:
    """Raise a UserError if the points of a scene contradict the depth maps of its training views (`check_direction`).

    depths: folder of the maps, for the message.
    """
    if info.point_cloud is None or info.has_random_points:
        return
    points = np.asarray(info.point_cloud.points, np.float64)[:: 1 + len(info.point_cloud.points) // _POINTS]
    views, found, metric = [view for view in info.train_cameras if view.depth], [], ""
    for view in views[:: 1 + len(views) // _VIEWS]:
        x, y, inside = projected(view, points)
        local = (points @ view.R + view.T)[inside]
        z = np.linalg.norm(local, axis=1) if view.native else local[:, 2]
        values = read_values(view.depth.path)
        metric = METRIC if view.depth.metric else ""
        pixels = np.stack([x, y], axis=1)[inside]
        found.append(_sample_map(pixels, z, (view.width, view.height), inverses(values) if metric else values))
    check_direction(found, depths, metric)


def check_direction(maps: Sequence[tuple[np.ndarray, np.ndarray]], depths: Path, metric: str = "") -> None:
    """Raise a UserError if the values of most maps rise with depth, as inverse depths never do.

    maps: for each map, inverse depths (n,) at points, and the depths z (n,) of these points.
    depths: folder of the maps, for the message.
    metric: name of the file that declares the maps metric, so that their values were inverted; empty: none does.
    """
    found = []
    for values, z in maps:
        known = np.isfinite(values)
        if known.sum() >= MIN_POINTS and min(np.ptp(values[known]), np.ptp(z[known])) > 0:
            found.append(np.corrcoef(*(order.argsort().argsort() for order in (values[known], -z[known])))[0, 1])
    if not found or np.median(found) > _OPPOSITE:
        return
    is_not, remedy = (
        "depths, not inverse depths",
        f'put a file {METRIC} beside them, as {{"{STEP}": 0.001}} for millimetres',
    )
    if metric:
        is_not, remedy = "inverse depths, not depths", f"save them as grey PNGs, without {metric}"
    raise UserError(f"the values of most maps in {depths} are {is_not}: they change with the points' depths; {remedy}")


def fit_image(pixels: np.ndarray, z: np.ndarray, size: tuple[int, int], depth: np.ndarray) -> tuple[float, float]:
    """Scale and offset of a map (h, w) of any resolution, from the points in front of the camera and in the photo.

    pixels (n,2) of a photo of a size (width, height), and their depths z (n,), as of `sightings`.
    """
    mono, z = _sample_map(pixels, z, size, depth)
    return fit_line(mono, 1 / z)


def _sample_map(
    pixels: np.ndarray, z: np.ndarray, size: tuple[int, int], depth: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A map's values, and z, at those of the points that are in front of the camera and in the photo."""
    x, y = pixels.T
    inside = (x >= 0) & (y >= 0) & (x < size[0]) & (y < size[1]) & (z > 0)
    x, y = x[inside] * depth.shape[1] / size[0] - 0.5, y[inside] * depth.shape[0] / size[1] - 0.5
    return sample(depth, x, y), z[inside]


def fit_line(mono: np.ndarray, colmap: np.ndarray) -> tuple[float, float]:
    """Scale and offset with colmap = scale * mono + offset, for samples (n,), robust against outliers.

    The reference's fit: the line goes through both medians, and its slope is the ratio of the mean distances from them.
    Both are 0 for fewer than 11 samples, or when either side does not vary.
    """
    if len(colmap) < MIN_POINTS or np.ptp(colmap) <= MIN_RANGE or np.ptp(mono) == 0:
        return 0.0, 0.0
    middle, mono_middle = np.median(colmap), np.median(mono)
    scale = np.abs(colmap - middle).mean() / np.abs(mono - mono_middle).mean()
    return float(scale), float(middle - scale * mono_middle)
