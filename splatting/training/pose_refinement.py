"""Poses that are trained with the Gaussians (--refine_poses): a bounded correction of each training camera.

Each has Adam of its own. The tracks of structure from motion hold the cameras: before the training every view, test
views included, takes the pose of least reprojection error, and then the error stays a part of the loss.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from scene.cameras import Camera
from scene.readers.tracks import read_tracks
from scene.reprojection import moved_pose, nearest_pose, pull
from scene.scene import Scene
from utils.general_utils import get_expon_lr_func
from utils.graphics_utils import world_to_camera
from utils.system_utils import UserError

# Twists are rotations in radians, and translations in extents of the scene.
BOUND = 0.05  # of a correction's rotation, and of its translation
_RATES = 1e-4, 1e-6  # of the first and the last step
_BETAS, _EPS = (0.9, 0.99), 1e-12
_ANCHOR = 1e-3  # weight of each point's squared reprojection error (pixels) in the loss of its view
_STATE = ("twists", "mean", "square", "counts")


class PoseRefinement:
    """The corrections of a scene's training cameras. Its cameras always have their current poses.

    twists (n, 6) float64, by the cameras' uid.
    """

    def __init__(self, scene: Scene, source_path: str, steps: int) -> None:
        """steps: of the schedule. UserError for a scene without tracks."""
        info, self._unit = scene.info, scene.cameras_extent
        lists = [sorted(of, key=lambda camera: camera.uid) for of in (scene.getTrainCameras(), scene.getTestCameras())]
        tracks = read_tracks(source_path, info.train_cameras + info.test_cameras, info.offset)
        if not any(tracks[: len(lists[0])]):
            raise UserError(
                "--refine_poses needs the tracks of a COLMAP model, the places of its points in the photos, and "
                f"{source_path} has none; leave it out"
            )
        for camera, track in zip(lists[0] + lists[1], tracks, strict=True):
            _place(camera, nearest_pose(_pose_of(camera), track, camera.fx, self._unit, BOUND))
        self._cameras, self._tracks = lists[0], tracks[: len(lists[0])]
        self._starts = [_pose_of(camera) for camera in self._cameras]
        self._rate = get_expon_lr_func(*_RATES, max_steps=steps)
        self._drift = _drift(self._starts, self._unit)
        count = len(self._cameras)
        self.twists, self.mean, self.square = (np.zeros((count, 6)) for _ in range(3))
        self.counts = np.zeros(count)
        self._gradient: tuple[int, np.ndarray] | None = None
        held = sum(track is not None for track in tracks)
        print(f"--refine_poses corrects {held} of {len(tracks)} poses, and takes every step as --plain_step does")

    def settle(self, camera: Camera) -> None:
        """Give a smaller copy of a training camera its current pose."""
        if camera is not self._cameras[camera.uid]:
            _place(camera, self._pose(camera.uid))

    def _pose(self, uid: int) -> np.ndarray:
        return moved_pose(self._starts[uid], self.twists[uid], self._unit)

    def take_gradient(self, uid: int, gradient: Tensor) -> None:
        """Keep the gradient (6,) of an image's loss by a twist in world units at a camera's pose, for `step`.

        A camera without a track, which nothing would hold, gets none.
        """
        found = gradient.double().cpu().numpy()
        found = np.concatenate([found[:3], self._unit * found[3:]])
        if (track := self._tracks[uid]) is None:
            found = np.zeros(6)
        else:
            found = found + _ANCHOR * pull(self._pose(uid), track, self._cameras[uid].fx, self._unit).gradient
        self._gradient = uid, found

    def step(self, step: int) -> None:
        """Take the step of Adam (Kingma and Ba 2015) of the camera whose gradient was kept. step: of the schedule."""
        (uid, gradient), self._gradient = self._gradient, None
        if not np.isfinite(gradient).all():
            return
        self.counts[uid] += 1
        for average, beta, value in ((self.mean, _BETAS[0], gradient), (self.square, _BETAS[1], gradient**2)):
            average[uid] = beta * average[uid] + (1 - beta) * value
        mean, square = (
            a[uid] / (1 - b ** self.counts[uid]) for a, b in zip((self.mean, self.square), _BETAS, strict=True)
        )
        twist = self.twists[uid] - self._rate(step) * mean / (np.sqrt(square) + _EPS)
        for part in (twist[:3], twist[3:]):
            part *= min(1, BOUND / max(np.linalg.norm(part), BOUND))
        self.twists[uid] = twist
        if self.counts.sum() % len(self._cameras):
            return _place(self._cameras[uid], self._pose(uid))
        # The scene does not walk, turn or grow: what all cameras could do together is taken out.
        basis, inverse = self._drift
        flat = self.twists.reshape(-1)
        flat -= np.einsum("ak,a->k", basis, np.einsum("ab,b->a", inverse, np.einsum("ak,k->a", basis, flat)))
        self._place_all()

    def _place_all(self) -> None:
        for camera in self._cameras:
            _place(camera, self._pose(camera.uid))

    def captured(self) -> dict[str, Any]:
        """State that a resumed training needs, as plain values."""
        arrays = {name: torch.from_numpy(getattr(self, name).copy()) for name in _STATE}
        return {"names": [camera.image_name for camera in self._cameras], **arrays}

    def restore(self, state: dict[str, Any] | None) -> None:
        """Take the state of `captured()`. UserError for one that does not fit, or None."""
        names = [camera.image_name for camera in self._cameras]
        shapes = {name: getattr(self, name).shape for name in _STATE}
        fits = isinstance(state, dict) and state.get("names") == names
        if not fits or any(getattr(state.get(name), "shape", None) != shape for name, shape in shapes.items()):
            raise UserError("the checkpoint has no refined poses of this run's views; leave --refine_poses out")
        for name in _STATE:
            getattr(self, name)[:] = state[name].numpy()
        self._place_all()


def _pose_of(camera: Camera) -> np.ndarray:
    return world_to_camera(camera.R, camera.T)


def _place(camera: Camera, pose: np.ndarray) -> None:
    camera.place(pose[:3, :3].T.copy(), pose[:3, 3].copy())


def _drift(poses: list[np.ndarray], unit: float) -> tuple[np.ndarray, np.ndarray]:
    """Twists (7, 6 n) by which all cameras turn, move and grow apart as one, and the inverse of their products (7, 7).

    About the cameras' middle, for well-conditioned numbers.
    """
    centers = np.array([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])
    twists = np.zeros((7, len(poses), 6))
    for place, pose in enumerate(poses):
        turn, middle = pose[:3, :3], pose[:3, :3] @ centers.mean(0) + pose[:3, 3]
        for axis in range(3):
            twists[axis, place] = [*turn[:, axis], *np.cross(middle, turn[:, axis]) / unit]
            twists[3 + axis, place, 3:] = turn[:, axis]
        twists[6, place, 3:] = middle / unit
    basis = twists.reshape(7, -1)
    return basis, np.linalg.pinv(np.einsum("ak,bk->ab", basis, basis), hermitian=True)
