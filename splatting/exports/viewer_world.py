"""The vendored viewer's world: the turn that puts a model upright, and the settings of cameras and animation.

The viewer's axes are x right, y up, z backwards, and its camera has no roll. The form of the settings is that of its
settings.json, version 2 (docs/api.md and dist/settings.d.ts of the npm package).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from splatting.camera_paths.moments import TimedPath
from splatting.camera_paths.poses import Poses, focus_point
from splatting.exports.splats import Splats
from utils.sh_utils import sh_basis

UP = np.array([0.0, -1.0, 0.0])  # of the turned model, as in a usual capture
_MEAN_UP = 0.01  # weight of the mean up beside the cameras' horizons
_DIRECTIONS = 64  # more than the 25 coefficients that they determine
BOOKMARKS = 25  # the viewer's own limit of annotations
_TITLE = 60  # and of letters in their titles
_KEYS_A_SECOND = 10
_MOST_KEYS = 1000
_VIEWER_AXES = np.diag([-1.0, -1.0, 1.0])  # the viewer turns each model by half a turn about z
_OFF = {"enabled": False}
_NO_EFFECTS = {  # the viewer's post effects
    "sharpness": {**_OFF, "amount": 0},
    "bloom": {**_OFF, "intensity": 0.1, "blurLevel": 2},
    "grading": {**_OFF, "brightness": 1, "contrast": 1, "saturation": 1, "tint": [1, 1, 1]},
    "vignette": {**_OFF, "intensity": 0.5, "inner": 0.3, "outer": 0.75, "curvature": 1},
    "fringing": {**_OFF, "intensity": 0.5},
}


def up_of(poses: Poses) -> np.ndarray:
    """The direction (3,), of length 1, that is up for most cameras: the one in which their rolls are least.

    A level camera has its x axis at right angles to up, however far it looks down. So up is the eigenvector of the
    least eigenvalue of the mean of x x^T; where cameras face one way and leave it open, their mean up decides.
    """
    mean, across = poses.up, poses.turns[:, :, 0]
    mean = mean / max(float(np.linalg.norm(mean)), 1e-9)
    matrix = across.T @ across / len(poses) + _MEAN_UP * (np.eye(3) - np.outer(mean, mean))
    up = np.linalg.eigh(matrix)[1][:, 0]
    return up if up @ mean >= 0 else -up


def turn_upright(up: np.ndarray) -> np.ndarray:
    """The least rotation (3,3) that takes a direction to UP."""
    axis, cosine = np.cross(up, UP), float(up @ UP)
    sine = float(np.linalg.norm(axis))
    axis = axis / sine if sine > 1e-9 else np.array([0.0, 0.0, 1.0])
    return Rotation.from_rotvec(axis * np.arctan2(sine, cosine)).as_matrix()


def turned(splats: Splats, turn: np.ndarray) -> Splats:
    """The same Gaussians in a world turned by a rotation (3,3); its offset is not kept."""
    rotation = Rotation.from_matrix(turn) * Rotation.from_quat(np.roll(splats.rotations, -1, axis=1))
    return replace(
        splats,
        means=(splats.means @ turn.T).astype(np.float32),
        rotations=np.roll(rotation.as_quat(), 1, axis=1).astype(np.float32),
        sh=np.einsum("jk,nkc->njc", _sh_turn(splats.sh_degree, turn).astype(np.float32), splats.sh),
        world_offset=(0.0, 0.0, 0.0),
    )


def _sh_turn(degree: int, turn: np.ndarray) -> np.ndarray:
    """The matrix (K,K) of SH coefficients: the new function at a direction d is the old one at turn^T d."""
    directions = torch.randn(_DIRECTIONS, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    directions = torch.nn.functional.normalize(directions)
    new, old = sh_basis(degree, directions), sh_basis(degree, directions @ torch.from_numpy(turn))
    return torch.linalg.lstsq(new, old).solution.numpy()


def settings(
    poses: Poses,
    names: Sequence[str],
    turn: np.ndarray,
    path: TimedPath | None,
    background: tuple[float, float, float],
    distance: float = 1.0,
) -> dict[str, Any]:
    """The settings of a model that was turned by `turn` (3,3).

    poses, names: of the training cameras before that, the first of which is where the viewer begins. path: the
    animation, in the same frame. background: RGB in [0,1]. distance: of the model, about which cameras that are all in
    one place turn. Opening angles are vertical, in degrees.
    """
    axes = _VIEWER_AXES @ turn
    focus = focus_point(poses)
    depths = _depths(poses, focus, distance)
    cameras = [_look(axes, *camera) for camera in zip(poses.positions, poses.turns, depths, poses.fov, strict=True)]
    marked = np.unique(np.linspace(0, len(cameras) - 1, BOOKMARKS).round().astype(int)).tolist()
    return {
        "version": 2,
        "tonemapping": "none",
        "highPrecisionRendering": False,
        "background": {"color": list(background)},
        "postEffectSettings": _NO_EFFECTS,
        "animTracks": [] if path is None else [_track(path, axes, float(np.median(depths)))],
        "cameras": [{"initial": cameras[0]}],
        "annotations": [_bookmark(names[n], cameras[n], lean(axes @ poses.turns[n])) for n in marked],
        "startMode": "default" if path is None else "animTrack",
    }


def _depths(poses: Poses, focus: np.ndarray | None, distance: float) -> np.ndarray:
    """How far along each axis the point about which that camera turns lies: at the focus, or near it."""
    if focus is None:
        return np.full(len(poses), max(poses.spread or distance, 1e-3))
    ahead = ((focus - poses.positions) * poses.forward).sum(axis=1)
    return np.where(ahead > 0, ahead, np.median(ahead))


def lean(turn: np.ndarray) -> float:
    """Degrees by which a camera with axes `turn` (3,3) in the viewer's world must be rolled from a level one.

    About its backward axis, and level as the viewer's cameras are: turned about y, then about their own x.
    """
    yaw = np.arctan2(-turn[0, 2], -turn[2, 2])
    level = np.array([np.cos(yaw), 0, -np.sin(yaw)])
    return float(np.degrees(np.arctan2(turn[:, 1] @ level, turn[:, 0] @ level)))


def _look(axes: np.ndarray, position: np.ndarray, turn: np.ndarray, depth: float, fov: float) -> dict[str, Any]:
    target = position + depth * turn[:, 2]
    return {"position": (axes @ position).tolist(), "target": (axes @ target).tolist(), "fov": float(fov)}


def _bookmark(name: str, camera: dict[str, Any], degrees: float) -> dict[str, Any]:
    """An annotation at the camera's own place. The viewer's cameras are level, so our page adds the lean."""
    title = name if len(name) <= _TITLE else "…" + name[1 - _TITLE :]
    return {
        "position": camera["position"],
        "title": title,
        "text": "",
        "camera": {"initial": camera},
        "extras": {"lean": degrees},
    }


def _track(path: TimedPath, axes: np.ndarray, depth: float) -> dict[str, Any]:
    count = max(2, min(_MOST_KEYS, round(path.seconds * _KEYS_A_SECOND) + 1))
    rate = (count - 1) / path.seconds
    frames = range(count - path.closed)  # the end of a closed path is its beginning
    keys = [path.at(min(frame / rate, path.seconds)) for frame in frames]
    turns = Rotation.from_quat([np.roll(key.wxyz, -1) for key in keys]).as_matrix()
    looks = [_look(axes, np.array(k.position), turn, depth, k.fov) for k, turn in zip(keys, turns, strict=True)]
    return {
        "name": "camera path",
        "duration": path.seconds,
        "frameRate": rate,
        "loopMode": "repeat" if path.closed else "none",
        "interpolation": "spline",
        "smoothness": 1,
        "keyframes": {
            "times": list(frames),
            "values": {
                "position": [value for look in looks for value in look["position"]],
                "target": [value for look in looks for value in look["target"]],
                "fov": [look["fov"] for look in looks],
            },
        },
    }
