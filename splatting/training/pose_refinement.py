"""Poses that are trained with the Gaussians (--refine_poses): a bounded correction of each training camera.

Each has Adam of its own. The tracks of structure from motion hold the cameras. Before the training every view, test
views included, takes the pose of least reprojection error. The error, to second order about there, then stays a part
of the loss.
"""

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import torch

from scene.cameras import Camera
from scene.readers.tracks import read_tracks
from scene.reprojection import BOUND, moved_pose, nearest_pose, pull, twist_gradient
from scene.scene import Scene
from splatting.evaluation.training_log import DEGREES, PERCENT
from utils.general_utils import get_expon_lr_func
from utils.graphics_utils import world_to_camera
from utils.system_utils import UserError

# Twists are rotations in radians, and translations in extents of the scene.
_RATES = 1e-4, 1e-6  # of the first and the last step
_BETAS, _EPS = (0.9, 0.99), 1e-12
_ANCHOR = 1e-3  # weight of each point's squared reprojection error (pixels) in the loss of its view
_PASSES = 10  # over all views, after which drift is taken out: each time the GPU is waited for
_STATE = ("twists", "mean", "square", "counts")


class PoseRefinement:
    """The corrections of a scene's training cameras. `place` gives the cameras their current poses.

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
        self._given = [_pose_of(camera) for camera in lists[0]]
        for camera, track in zip(lists[0] + lists[1], tracks, strict=True):
            pose = nearest_pose(_pose_of(camera), track, camera.fx, self._unit, BOUND)
            camera.place(pose[:3, :3].T.copy(), pose[:3, 3].copy())
        self._cameras = lists[0]
        self._starts = [_pose_of(camera) for camera in self._cameras]
        held = zip(self._starts, tracks, self._cameras, strict=False)  # the tracks of test views are left
        pulls = [track and pull(start, track, camera.fx, self._unit) for start, track, camera in held]
        self._held = [of_track and (of_track.gradient, of_track.curvature) for of_track in pulls]
        self._rate = get_expon_lr_func(*_RATES, max_steps=steps)
        self._drift = _drift(self._starts, self._unit)
        count = len(self._cameras)
        self.twists, self.mean, self.square = (np.zeros((count, 6)) for _ in range(3))
        self.counts = np.zeros(count)
        self._poses: dict[int, np.ndarray] = {}  # that are known
        self._moved: set[int] = set()  # since `place`
        print(f"--refine_poses corrects {sum(track is not None for track in tracks)} of {len(tracks)} poses")

    def pose(self, uid: int) -> tuple[np.ndarray, np.ndarray]:
        """R and T of a training camera's current pose, as `Camera` has them."""
        pose = self._pose(uid)
        return pose[:3, :3].T.copy(), pose[:3, 3].copy()

    def _pose(self, uid: int) -> np.ndarray:
        if uid not in self._poses:
            self._poses[uid] = moved_pose(self._starts[uid], self.twists[uid], self._unit)
        return self._poses[uid]

    def place(self, copy: Camera | None = None) -> None:
        """Give the training cameras their current poses, and a smaller copy of one its own."""
        for uid in self._moved:
            self._cameras[uid].place(*self.pose(uid))
        self._moved.clear()
        if copy is not None and copy is not self._cameras[copy.uid]:
            copy.place(*self.pose(copy.uid))

    def independent(self, uid: int, pending: Sequence[int]) -> int:
        """On how many of the last steps a camera's next pose does not depend. pending: the cameras of steps to come."""
        most, taken, all_passes = len(pending), int(self.counts.sum()), _PASSES * len(self._cameras)
        if (taken + most) // all_passes > taken // all_passes:
            most = (taken + most) % all_passes
        return min(most, pending[::-1].index(uid)) if uid in pending else most

    def step(self, uid: int, gradient: np.ndarray, step: int) -> None:
        """Take the step of a camera. step: of the schedule.

        gradient: of the image's loss by the camera's numbers (diff_gaussian_rasterization/camera.py). A camera without
        a track, which nothing would hold, gets none.
        """
        self.counts[uid] += 1
        found = np.zeros(6)
        if (held := self._held[uid]) is not None:
            at_start, curvature = held
            found = twist_gradient(self._pose(uid), gradient, self._unit)
            found += _ANCHOR * (at_start + curvature @ self.twists[uid])
        if np.isfinite(found).all():
            self._step(uid, found, self._rate(step))
        if self.counts.sum() % (_PASSES * len(self._cameras)):
            return self._move([uid])
        # The scene does not walk, turn or grow: what all cameras could do together is taken out.
        basis, inverse = self._drift
        flat = self.twists.reshape(-1)
        flat -= np.einsum("ak,a->k", basis, np.einsum("ab,b->a", inverse, np.einsum("ak,k->a", basis, flat)))
        self._move(range(len(self._cameras)))

    def _move(self, uids: Collection[int]) -> None:
        """Forget the poses of twists that have changed."""
        for uid in uids:
            self._poses.pop(uid, None)
        self._moved.update(uids)

    def _step(self, uid: int, gradient: np.ndarray, rate: float) -> None:
        """Take a step of Adam (Kingma and Ba 2015)."""
        for average, beta, value in ((self.mean, _BETAS[0], gradient), (self.square, _BETAS[1], gradient**2)):
            average[uid] = beta * average[uid] + (1 - beta) * value
        mean, square = (
            a[uid] / (1 - b ** self.counts[uid]) for a, b in zip((self.mean, self.square), _BETAS, strict=True)
        )
        twist = self.twists[uid] - rate * mean / (np.sqrt(square) + _EPS)
        for part in (twist[:3], twist[3:]):
            part *= min(1, BOUND / max(np.linalg.norm(part), BOUND))
        self.twists[uid] = twist

    def corrections(self) -> dict[str, float]:
        """How far training cameras are from the dataset's poses, on the mean: turn, and percent of the extent."""
        given, now = np.array(self._given), np.array([self._pose(uid) for uid in range(len(self.twists))])
        chords = np.linalg.norm(now[:, :3, :3] - given[:, :3, :3], axis=(1, 2)) / np.sqrt(8)
        centers = [-np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3]) for poses in (now, given)]
        apart = np.linalg.norm(centers[0] - centers[1], axis=1) / self._unit
        turns = np.degrees(2 * np.arcsin(np.minimum(chords, 1)))
        return {DEGREES: round(float(turns.mean()), 6), PERCENT: round(100 * float(apart.mean()), 6)}

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
        self._move(range(len(names)))
        self.place()


def _pose_of(camera: Camera) -> np.ndarray:
    return world_to_camera(camera.R, camera.T)


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
