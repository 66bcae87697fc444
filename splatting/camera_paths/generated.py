"""Paths made from the training cameras: through them, around what they look at, and a spiral in front of it."""

import math
from collections.abc import Callable

import numpy as np
from scipy.interpolate import PchipInterpolator

from splatting.camera_paths.interpolated import SECONDS, Interpolated
from splatting.camera_paths.keyframes import Keyframe
from splatting.camera_paths.moments import TimedPath
from splatting.camera_paths.poses import Poses, facing, focus_point, keyframe, unit
from utils.system_utils import UserError

_LARGEST_GAP = math.radians(120)  # between cameras around the focus: over it, no image shows what is seen from there
_LEAST_SWAY = math.radians(10)
_TILT = 0.8  # cosine of the angle between the cameras' plane and their up, from which the plane is believed
_OVERHEAD = 0.1  # sine of the angle between line of sight and up, below which the image would spin
_ONE_WAY = 0.7  # length of the mean optical axis, from which cameras face one way
_SAMPLES = 720


class Ellipse:
    """A closed path around the point nearest to all optical axes, looking at it (after Barron et al., Mip-NeRF 360).

    It lies in the plane of the cameras (principal components), at their mean height over it, up is their mean up. If
    that plane is not level, as of cameras on a wall or on a line, the level one takes its place. Half axes: those that
    90 % of the cameras are within. Speed is constant. Where cameras leave a gap of over 120 degrees, it sways to and
    fro on the arc that they cover, at their median distance.
    """

    closed = True

    def __init__(self, poses: Poses, seconds: float = SECONDS) -> None:
        self.seconds = seconds
        _refuse_one_place(poses, "ellipse")
        focus = focus_point(poses)
        if focus is None:
            raise UserError(
                "--path ellipse needs training cameras that look at one point, and these look past each other or "
                "outwards; take --path interpolate, or spiral if they face one way"
            )
        self.focus, self._fov = focus, float(np.median(poses.fov))
        normal = plane_normal(poses)
        self.up = normal if np.linalg.norm(poses.up) < _OVERHEAD else unit(poses.up)
        self._offset = ring(poses, focus, normal)
        if self._passes_overhead():
            self._offset = ring(poses, focus, self.up)

    def at(self, seconds: float) -> Keyframe:
        """The pose at a moment between 0 and `seconds`."""
        offset = self._offset(seconds / self.seconds)
        return keyframe(seconds, self.focus + offset, facing(-offset, self.up), self._fov)

    def _passes_overhead(self) -> bool:
        sights = [unit(self._offset(share)) for share in np.linspace(0, 1, 90)]
        return bool(min(np.linalg.norm(np.cross(sight, self.up)) for sight in sights) < _OVERHEAD)


class Spiral:
    """A closed path of two turns about the mean camera, for cameras that face one way (after Mildenhall et al., LLFF).

    Its radii, to the sides, up and along the axis, are those that 90 % of the cameras are within. It looks at the point
    nearest to the optical axes, moved onto the mean axis, or straight ahead where they are parallel.
    """

    closed = True

    def __init__(self, poses: Poses, seconds: float = SECONDS) -> None:
        self.seconds = seconds
        _refuse_one_place(poses, "spiral")
        mean = poses.forward.mean(axis=0)
        if np.linalg.norm(mean) < _ONE_WAY or np.linalg.norm(np.cross(poses.up, unit(mean))) < _OVERHEAD:
            raise UserError(
                "--path spiral needs training cameras that face one way, and these face many; take --path ellipse or "
                "interpolate"
            )
        self._up, self._fov = unit(poses.up), float(np.median(poses.fov))
        self.middle, self._frame = poses.positions.mean(axis=0), facing(mean, self._up)
        self.radii = np.percentile(np.abs((poses.positions - self.middle) @ self._frame), 90, axis=0)
        focus = focus_point(poses)
        depth = 0.0 if focus is None else float((focus - self.middle) @ self._frame[:, 2])
        self.target = self.middle + depth * self._frame[:, 2] if depth > 2 * self.radii[2] else None

    def at(self, seconds: float) -> Keyframe:
        """The pose at a moment between 0 and `seconds`."""
        angle = 4 * math.pi * seconds / self.seconds
        share = np.array([math.cos(angle), -math.sin(angle), -math.sin(angle / 2)])
        position = self.middle + self._frame @ (share * self.radii)
        turn = self._frame if self.target is None else facing(self.target - position, self._up)
        return keyframe(seconds, position, turn, self._fov)


GENERATED: dict[str, Callable[[Poses, float], TimedPath]] = {
    "interpolate": Interpolated,
    "ellipse": Ellipse,
    "spiral": Spiral,
}


def plane_normal(poses: Poses) -> np.ndarray:
    """The normal (3,) of the plane of the cameras, upwards; their mean up if the plane is steep or undefined."""
    length = float(np.linalg.norm(poses.up))
    _, sizes, axes = np.linalg.svd(poses.positions - poses.positions.mean(axis=0))
    flat = len(poses) > 2 and sizes[1] > 1e-3 * sizes[0]
    if length < _OVERHEAD:  # heads in all directions
        return axes[2]
    level = float(axes[2] @ poses.up) / length
    return axes[2] * math.copysign(1.0, level) if flat and abs(level) >= _TILT else poses.up / length


def ring(poses: Poses, focus: np.ndarray, normal: np.ndarray) -> Callable[[float], np.ndarray]:
    """The way of `Ellipse` about a normal (3,): from a share of it, 0 to 1, the camera's place, less the focus (3,)."""
    offsets = poses.positions - focus
    height = float((offsets @ normal).mean())
    flat = offsets - (offsets @ normal)[:, None] * normal
    _, _, axes = np.linalg.svd(flat - flat.mean(axis=0))
    across = axes - np.outer(axes @ normal, normal)  # axes[0], but where the cameras are in one place of the plane
    first = unit(across[np.linalg.norm(across, axis=1).argmax()])
    first *= math.copysign(1.0, first @ flat[0])  # it begins on the side of the first camera
    plane = np.column_stack([first, np.cross(normal, first)])
    places = flat @ plane
    middle, half = covered_arc(np.arctan2(places[:, 1], places[:, 0]))
    if half < math.pi:
        radius = np.full(2, np.median(np.linalg.norm(places, axis=1)))
        return lambda share: _on(radius, middle + half * math.sin(2 * math.pi * share), plane) + height * normal
    radius = np.percentile(np.abs(places), 90, axis=0)
    angle_at = _even_angles(radius)
    return lambda share: _on(radius, float(angle_at(share)), plane) + height * normal


def covered_arc(angles: np.ndarray) -> tuple[float, float]:
    """Middle and half width of the arc that angles cover, in radians: 0 and pi if they leave no large gap."""
    angles = np.sort(angles)
    gaps = np.diff(np.append(angles, angles[0] + 2 * math.pi))
    widest = int(gaps.argmax())
    if gaps[widest] <= _LARGEST_GAP:
        return 0.0, math.pi
    half = (2 * math.pi - gaps[widest]) / 2
    return float(angles[widest] - half), max(float(half), _LEAST_SWAY)


def _on(radius: np.ndarray, angle: float, plane: np.ndarray) -> np.ndarray:
    return plane @ (radius * np.array([math.cos(angle), math.sin(angle)]))


def _even_angles(radius: np.ndarray) -> PchipInterpolator:
    """The angle of an ellipse with half axes (2,) after a share of its length."""
    angles = np.linspace(0, 2 * math.pi, _SAMPLES + 1)
    steps = np.diff(np.column_stack([radius[0] * np.cos(angles), radius[1] * np.sin(angles)]), axis=0)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])
    return PchipInterpolator(way / way[-1], angles)


def _refuse_one_place(poses: Poses, name: str) -> None:
    if not poses.spread:
        raise UserError(
            f"--path {name} needs training cameras in at least two places, and all of them are in one; take --path "
            "interpolate, or write keyframes into a file and pass that as --path"
        )
