"""A scene's similarity from points that somebody has measured, in the record of convert.py --orient."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from groundwork.files.similarity import PLACE, Similarity
from groundwork.host.errors import UserError

TINY = 1e-300  # instead of a length of 0
_OF_GPS = "gps_photos", "gps_error", "scale_error"


def measured_record(
    before: Mapping[str, Any] | None,
    above: np.ndarray,
    scale: float | None = None,
    ground: np.ndarray | None = None,
    front: np.ndarray | None = None,
) -> dict[str, Any]:
    """Return the record that takes the place of `before`, None: there was none. Points are of the scene's world.

    above: a point (3,) above the ground.
    scale: metres in a unit of the world.
    ground: three points (3,3) of one height; their middle becomes the origin.
    front: the left and the right end (2,3) of what a camera should face.

    What is not given stays; with ground or front, the place on Earth is unknown from then on. UserError for points
    that determine nothing.
    """
    record = dict(before or {"unit": "scene", "vertical": None})
    known = Similarity.read(record, "orientation") if before else Similarity(np.eye(3), 1.0, np.zeros(3), upright=False)
    axes, origin = known.rotation, -known.rotation.T @ known.translation / known.scale
    if ground is not None:
        down = _normalise(ground_normal(ground), "the three points of the ground lie on a line; choose others")
        down = -down if (above - ground[0]) @ down > 0 else down
        axes, origin = _level_axes(axes, down), ground.mean(0)
        record["vertical"] = "three points of the ground"
        record.pop("vertical_error", None)
    if front is not None:
        if record["vertical"] is None:
            raise UserError("a front needs to know what is up; click three points of the ground, too")
        along = front[1] - front[0]
        along /= np.linalg.norm(along).clip(TINY)
        right = _normalise(along - (along @ axes[1]) * axes[1], "the front goes straight up; choose other points")
        axes = np.stack([right, axes[1], np.cross(right, axes[1])])
    if ground is not None or front is not None:
        record = {name: value for name, value in record.items() if name not in PLACE}
    if scale is not None:
        record = {name: value for name, value in record.items() if name not in _OF_GPS} | {"unit": "metre"}
    scale = known.scale if scale is None else scale
    translation = -scale * axes @ origin
    return record | {"rotation": axes.tolist(), "scale": scale, "translation": translation.tolist()}


def ground_normal(ground: np.ndarray) -> np.ndarray:
    """The normal (3,) of three points (3,3); its length is the triangle's least height over its longest side."""
    sides = np.roll(ground, 1, 0) - ground
    longest = np.square(sides).sum(1).max()
    return np.cross(sides[0], sides[1]) / longest.clip(TINY)


def _normalise(vector: np.ndarray, fault: str) -> np.ndarray:
    """Scale a vector (3,) to length 1. UserError with `fault` if it is not finite, or shorter than 1e-6."""
    length = np.linalg.norm(vector)
    if not 1e-6 <= length < np.inf:
        raise UserError(fault)
    return vector / length


def _level_axes(axes: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Turn axes (3,3), by rows, as little as gives them the y axis `down` (3,)."""
    ahead = axes[2] - (axes[2] @ down) * down
    if np.linalg.norm(ahead) < 1e-3:  # it looked straight down
        ahead = axes[1] - (axes[1] @ down) * down
    ahead /= np.linalg.norm(ahead)
    return np.stack([np.cross(down, ahead), down, ahead])
