"""The similarity from a scene's world to an upright frame in metres, in a file beside the scene and in model.json."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from groundwork.files.json_files import LARGEST_OFFSET, OFFSET, read_json, read_model_json
from groundwork.host.errors import UserError

FILE = "orientation.json"  # of convert.py --orient, in a scene's folder
PLACE = "latitude", "longitude", "height"  # of the record, where GPS is known
ENTRY = "similarity"  # of model.json, with the content of that file
_LARGEST = 1e9  # scale, or one over it
_FARTHEST = 90, 360, 1e9  # PLACE


@dataclass(frozen=True)
class Similarity:
    """A point x (3,) of the scene's world becomes scale * rotation @ x + translation, float64.

    In the new frame y is down.

    rotation: (3,3).
    place: latitude and longitude (degrees) and height (metres) of the new frame's origin; x is then east and z north,
    in metres. Empty: unknown.
    upright: the vertical is known; else only the scale changes.
    metric: the unit of the new frame is a metre.
    """

    rotation: np.ndarray
    scale: float
    translation: np.ndarray
    place: tuple[float, ...] = ()
    upright: bool = True
    metric: bool = False

    @classmethod
    def read(cls, record: Any, where: str) -> "Similarity":
        """Read a record. UserError if it describes no similarity. where: name of its file or field, for the message."""
        try:
            rotation = np.array(record["rotation"], np.float64)
            scale, translation = float(record["scale"]), np.array(record["translation"], np.float64)
            turns = rotation.shape == (3, 3) and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
            sound = turns and np.linalg.det(rotation) > 0 and 1 / _LARGEST <= scale <= _LARGEST
            sound = sound and translation.shape == (3,) and np.abs(translation).max() <= LARGEST_OFFSET
            place = tuple(float(record[name]) for name in PLACE) if PLACE[0] in record else ()
            if not (sound and (np.abs(place or (0, 0, 0)) <= _FARTHEST).all()):
                raise ValueError
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise UserError(
                f"{where} has no rotation, scale and translation of a similarity that a scene may have; run convert.py "
                "--orient again"
            ) from error
        known = record.get("vertical", "") is not None, record.get("unit") == "metre"
        return cls(rotation, scale, translation, place, *known)

    def from_local(self, offset: np.ndarray) -> "Similarity":
        """The similarity for coordinates from which an offset (3,) of the world was subtracted."""
        moved = self.scale * self.rotation @ np.asarray(offset, np.float64) + self.translation
        return replace(self, translation=moved)

    def transform(self, points: np.ndarray) -> np.ndarray:
        """Map points (N,3) into the upright frame, float64."""
        return self.scale * np.asarray(points, np.float64) @ self.rotation.T + self.translation


def read_orientation(scene: Path) -> dict[str, Any] | None:
    """Read the record beside a scene; None without one. UserError if it is damaged."""
    path = scene / FILE
    if not path.is_file():
        return None
    try:
        record = read_json(path)
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"{path} is not JSON; run convert.py --orient again, or remove it") from error
    Similarity.read(record, str(path))
    return record


def recorded_similarity(model: str, scene: str) -> dict[str, Any]:
    """Read a model's model.json; add the similarity of the scene if that was oriented after the training."""
    record = read_model_json(model) if model else {}
    found = read_orientation(Path(scene)) if scene and ENTRY not in record else None
    return record if found is None else record | {ENTRY: found}


def local_similarity(model: str, scene: str) -> Similarity | None:
    """The similarity from a model's own coordinates, offset included; None if the scene was not oriented."""
    record = recorded_similarity(model, scene)
    if ENTRY not in record:
        return None
    return Similarity.read(record[ENTRY], f"orientation of {model}").from_local(record.get(OFFSET, (0.0, 0.0, 0.0)))
