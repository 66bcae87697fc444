"""Whether the exposures of a scene's photos differ."""

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.linalg import spsolve

from scene.cameras import Camera
from scene.readers.tracks import Track
from scene.scene import Scene
from utils.image_utils import as_float

EXPOSURES = 0.4  # stops; photos of a usual automatic exposure differ by 0.15 to 0.35
_DARK, _LIGHT = 0.02, 0.98  # of a channel; beyond, an exposure cannot be told
_OUTLIER = 0.6  # stops; a larger difference is no exposure (Tukey's biweight: Beaton and Tukey 1974)
_ROUNDS = 10
_LUMINANCE = (0.2126, 0.7152, 0.0722)  # of linear sRGB


def advise(scene: Scene, tracks: Sequence[Track | None]) -> Iterator[tuple[str, str]]:
    """Texts, and the options that they speak for, or none."""
    if any(tracks):
        cameras = sorted(scene.getTrainCameras(), key=lambda camera: camera.uid)
        spread = float(np.std(exposures(cameras, tracks)))
        asked = "--appearance ppisp" if spread > EXPOSURES else ""
        yield f"exposures of the photos differ by {spread:.2f} stops", asked


def exposures(cameras: list[Camera], tracks: list[Track | None]) -> np.ndarray:
    """Exposures (K,) in stops around their mean, of the photos that have a track.

    A robust fit: log2 of a luminance is the exposure of its photo and the albedo of its point.
    """
    logs, points, photos = [], [], []
    for track, camera in zip(tracks, cameras, strict=True):
        if track is None:
            continue
        image = as_float(camera.target(torch.zeros(3, device=camera.device))).cpu().numpy()
        column, row = (track.places * image.shape[:0:-1]).astype(int).T
        inside = (column >= 0) & (column < image.shape[2]) & (row >= 0) & (row < image.shape[1])
        colors = image[:, row[inside], column[inside]]
        usable = (colors.max(0) < _LIGHT) & (colors.min(0) > _DARK)
        logs.append(np.log2(np.tensordot(_LUMINANCE, _linear(colors[:, usable]), 1)))
        points.append(track.ranks[inside][usable])
        photos.append(np.full(len(points[-1]), len(photos)))
    log, point, photo = map(np.concatenate, (logs, points, photos))
    weight = np.ones(len(log))
    for _ in range(_ROUNDS):
        exposure, albedo = _fitted(log, weight, photo, point, len(logs))
        away = log - exposure[photo] - albedo[point]
        weight = np.maximum(1 - (away / _OUTLIER) ** 2, 1e-3) ** 2
    return exposure - exposure.mean()


def _fitted(
    values: np.ndarray, weight: np.ndarray, photo: np.ndarray, point: np.ndarray, photos: int
) -> tuple[np.ndarray, np.ndarray]:
    """Exposures (photos,) and albedos whose sums are nearest to values (K,), by weighted least squares.

    Albedos are eliminated (Triggs et al. 2000, section 6.1). To fit both by turns would take as many rounds as a walk
    has photos.
    """
    seen = sparse.coo_array((weight, (photo, point)), (photos, point.max(initial=0) + 1)).tocsr()
    of_point, of_photo = (np.maximum(seen.sum(axis), 1e-9) for axis in (0, 1))
    matrix = sparse.diags_array((1 + 1e-9) * of_photo) - seen / of_point @ seen.T  # singular else: their sum is free
    mean = np.bincount(point, weight * values) / of_point
    vector = np.bincount(photo, weight * (values - mean[point]), photos)
    exposure = spsolve(matrix.tocsc(), vector)
    return exposure, np.bincount(point, weight * (values - exposure[photo])) / of_point


def _linear(values: np.ndarray) -> np.ndarray:
    """sRGB to light (IEC 61966-2-1)."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
