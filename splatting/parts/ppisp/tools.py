"""Whether the exposures of a scene's photos differ."""

from collections.abc import Iterator, Sequence

import numpy as np
import torch

from scene.cameras import Camera
from scene.images import exposures as by_points
from scene.images.exposures import EXPOSURES
from scene.readers.tracks import Track
from scene.scene import Scene
from splatting.findings import Finding, note
from utils.image_utils import as_float


def advise(scene: Scene, tracks: Sequence[Track | None]) -> Iterator[Finding]:
    """Numbers of a scene, and the options that they speak for."""
    if any(tracks):
        cameras = sorted(scene.getTrainCameras(), key=lambda camera: camera.uid)
        spread = float(np.std(exposures(cameras, tracks)))
        asked = "--appearance ppisp" if spread > EXPOSURES else ""
        yield note(f"exposures of the photos differ by {spread:.2f} stops", asked)


def exposures(cameras: list[Camera], tracks: list[Track | None]) -> np.ndarray:
    """Exposures (K,) in stops around their mean, of the photos that have a track."""
    colors, points = [], []
    for track, camera in zip(tracks, cameras, strict=True):
        if track is None:
            continue
        image = as_float(camera.target(torch.zeros(3, device=camera.device))).cpu().numpy()
        column, row = (track.places * image.shape[:0:-1]).astype(int).T
        inside = (column >= 0) & (column < image.shape[2]) & (row >= 0) & (row < image.shape[1])
        colors.append(image[:, row[inside], column[inside]].T)
        points.append(track.ranks[inside])
    return by_points.exposures(colors, points)
