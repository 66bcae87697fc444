"""Fit of a scene's depth maps, whose scale and offset are unknown, to its COLMAP points: depth_params.json."""

import json
from pathlib import Path

import numpy as np
from tqdm import tqdm

from scene.readers.colmap_model import Sightings, find_model, read_sightings
from scene.readers.depth_maps import PARAMS, read_values, sample
from utils.system_utils import UserError, atomic_write

UNIT = 65535.0  # of a map's values in the fit
MIN_POINTS = 11
MIN_RANGE = 1e-3  # of the points' inverse depths, 1 / world units


def make_depth_params(scene: Path, depths: Path, model_type: str) -> tuple[dict[str, dict[str, float]], int]:
    """Fit every registered photo that has a map in `depths`, and write depth_params.json into the model's folder.

    model_type: bin or txt. Returns the table and the number of registered photos. The table has `scale` and `offset` by
    photo name without extension, both 0 if there are too few points. UserError when no photo has a map, or the scene
    has no COLMAP model.
    """
    if not (scene / "sparse").is_dir():
        raise UserError(
            f"no folder sparse in {scene}: maps are fitted to the points of a COLMAP model; name a COLMAP scene "
            "(--base_dir), or train a Blender scene (transforms_train.json) without a fit"
        )
    model, _ = find_model(scene)
    table, pictures = {}, read_sightings(model, model_type)
    for sightings in tqdm(pictures, desc="Fitting depth maps", unit="map"):
        name = Path(sightings.name).with_suffix("").as_posix()
        path = depths / f"{name}.png"
        if path.is_file():
            scale, offset = fit_picture(sightings, read_values(path) / UNIT)
            table[name] = {"scale": scale, "offset": offset}
    if not table:
        raise UserError(f"no depth map in {depths} belongs to a photo of {model}; name maps like the photos, with .png")
    with atomic_write(model / PARAMS) as path:
        path.write_text(json.dumps(table, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return table, len(pictures)


def fit_picture(sightings: Sightings, depth: np.ndarray) -> tuple[float, float]:
    """Scale and offset of a map (h, w) of any resolution, from the points in front of the camera and in the photo."""
    x, y = sightings.pixels.T
    inside = (x >= 0) & (y >= 0) & (x < sightings.width) & (y < sightings.height) & (sightings.depths > 0)
    height, width = depth.shape
    x, y = x[inside] * width / sightings.width - 0.5, y[inside] * height / sightings.height - 0.5
    return fit_line(sample(depth, x, y), 1 / sightings.depths[inside])


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
