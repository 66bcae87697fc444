"""A camera in motion: its pose at each moment, and keyframes in a JSON file, which the viewer writes."""

import math
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from groundwork.files.json_files import read_json, write_json
from utils.system_utils import UserError

EASINGS = ("linear", "smooth")
_FOV = 0.001, 179.9  # degrees; outside, the numbers of a projection have no meaning in float32
_FARTHEST = 1e12  # as for the cameras of a scene


@dataclass(frozen=True)
class Keyframe:
    """A pose of a camera at a time.

    seconds: from the path's start. position: world coordinates. wxyz: unit quaternion that turns camera axes (x right,
    y down, z forward) into world axes. fov: vertical opening angle in degrees.
    """

    seconds: float
    position: tuple[float, float, float]
    wxyz: tuple[float, float, float, float]
    fov: float


@dataclass(frozen=True)
class CameraPath:
    """Keyframes in the order of their seconds. easing: "linear" or "smooth" (stands still at each keyframe)."""

    keyframes: tuple[Keyframe, ...]
    easing: str = "linear"

    @property
    def seconds(self) -> float:
        """Duration of the path."""
        return self.keyframes[-1].seconds

    def write(self, path: Path) -> None:
        """Write the JSON file, the whole file or none."""
        write_json(path, asdict(self), sort_keys=False)


class TimedPath(Protocol):
    """A camera in motion. seconds: duration. closed: whether the last pose is the first one."""

    seconds: float
    closed: bool

    def at(self, seconds: float) -> Keyframe:
        """The pose at a moment between 0 and `seconds`."""


def frame_count(path: TimedPath, fps: int) -> int:
    """Frames of a video: round(seconds * fps), and one more for the end of a path that is not closed.

    Frame i shows the moment i / fps. A closed path is shown without its end, so that the video can be played in a loop.
    """
    return max(1, round(path.seconds * fps) + (not path.closed))


def frame_moment(path: TimedPath, fps: int, frame: int) -> float:
    """The moment that a frame shows, in seconds from the path's start."""
    return min(frame / fps, path.seconds)


class KeyframePath:
    """A camera that goes from keyframe to keyframe.

    Positions on straight lines, turns the short way about one axis (Shoemake, SIGGRAPH 1985: slerp), opening angles in
    proportion; with the easing "smooth" by the polynomial 3 u^2 - 2 u^3, which stands still at each keyframe.
    """

    closed = False

    def __init__(self, path: CameraPath) -> None:
        """Prepare the interpolation between the keyframes of a path: of positions, fields of view and rotations."""
        from scipy.spatial.transform import Rotation, Slerp  # takes a while to import

        self.seconds = path.seconds
        self._smooth = path.easing == "smooth"
        self._moments = np.array([key.seconds for key in path.keyframes])
        self._rows = np.array([[*key.position, key.fov] for key in path.keyframes])
        turns = Rotation.from_quat([key.wxyz for key in path.keyframes], scalar_first=True)
        # In keyframes, not in seconds: neighbours may be nearer in time than Slerp can divide by.
        self._slerp = Slerp(np.arange(len(turns)), turns)

    def at(self, seconds: float) -> Keyframe:
        """The pose at a moment between 0 and `seconds`."""
        before = int(np.searchsorted(self._moments, seconds, side="right") - 1)
        before = min(max(before, 0), len(self._moments) - 2)
        start, end = self._moments[before : before + 2]
        share = min(max((seconds - start) / (end - start), 0.0), 1.0)
        if self._smooth:
            share *= share * (3 - 2 * share)
        row = self._rows[before] * (1 - share) + self._rows[before + 1] * share
        wxyz = self._slerp(before + share).as_quat(scalar_first=True)
        return Keyframe(seconds, tuple(row[:3].tolist()), tuple(wxyz.tolist()), float(row[3]))


def read_camera_path(path: Path) -> CameraPath:
    """Read a file of `CameraPath.write`, or one written by hand. UserError, naming the keyframe, for a wrong one."""
    content = _read_content(path)
    if not isinstance(content, dict) or not isinstance(content.get("keyframes"), list):
        raise UserError(f"{path} is no camera path: it needs a list called keyframes")
    keyframes = tuple(_read_keyframe(entry, f"{path}: keyframe {n}") for n, entry in enumerate(content["keyframes"], 1))
    if len(keyframes) < 2:
        raise UserError(f"{path} has {len(keyframes)} keyframes; a camera path needs at least 2")
    for n, (one, next_) in enumerate(zip(keyframes, keyframes[1:], strict=False), 2):
        if next_.seconds <= one.seconds:
            raise UserError(f"{path}: keyframe {n} is at {next_.seconds} s, not after keyframe {n - 1}")
    if keyframes[0].seconds:
        raise UserError(f"{path}: keyframe 1 must be at 0 seconds, got {keyframes[0].seconds}")
    easing = content.get("easing", "linear")
    if easing not in EASINGS:
        raise UserError(f"{path}: easing must be {' or '.join(EASINGS)}, got {easing!r}")
    return CameraPath(keyframes, easing)


def _read_content(path: Path) -> Any:
    """Read the JSON content of a path's file. UserError for a file that cannot be read."""
    try:
        return read_json(path)
    except OSError as error:
        raise UserError(
            f"cannot read the camera path {path} ({error.strerror}); pass another file, or fix its permissions"
        ) from error
    except (ValueError, RecursionError) as error:
        reason = "nested too deep" if isinstance(error, RecursionError) else error
        raise UserError(f"the camera path {path} is not JSON ({reason}); save it again from the viewer") from error


def _read_keyframe(entry: Any, where: str) -> Keyframe:
    """Read one keyframe from its JSON object, and check its values. where: its place, for messages."""
    if not isinstance(entry, dict):
        raise UserError(f"{where} must be an object with seconds, position, wxyz and fov")
    seconds, fov = _read_numbers(entry, "seconds", None, where)[0], _read_numbers(entry, "fov", None, where)[0]
    position, wxyz = _read_numbers(entry, "position", 3, where), _read_numbers(entry, "wxyz", 4, where)
    length = math.hypot(*wxyz)
    if not _FOV[0] <= fov <= _FOV[1]:
        raise UserError(f"{where}: fov must be {_FOV[0]} to {_FOV[1]} degrees, got {fov}")
    if max(map(abs, position)) > _FARTHEST:
        raise UserError(f"{where}: position must be at most {_FARTHEST:g} from the origin, got {list(position)}")
    if not 1e-6 < length < 1e6:
        raise UserError(f"{where}: wxyz must be a unit quaternion, got {list(wxyz)}")
    return Keyframe(seconds, position, tuple(value / length for value in wxyz), fov)


def _read_numbers(entry: dict, name: str, count: int | None, where: str) -> tuple[float, ...]:
    """Return the finite numbers of an entry: a list of `count`, or with None a single number."""
    value = entry.get(name)
    values = value if count else [value]
    what = f"{count} numbers" if count else "a number"
    if not isinstance(values, list) or len(values) != (count or 1) or not all(map(_is_number, values)):
        raise UserError(f"{where}: {name} must be {what}, got {repr(value)[:80]}")
    return tuple(float(number) for number in values)


def _is_number(value: Any) -> bool:
    # Comparisons, as an integer of JSON may be too large for a float.
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
