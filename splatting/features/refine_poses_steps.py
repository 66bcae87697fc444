"""Steps of poses that are trained with the Gaussians (--refine_poses): a bounded correction of each training camera.

Each camera has its own averages of Adam. The tracks of structure from motion hold the cameras (`TrackedPoses`). All
numbers are on the host. Each of several processes takes all steps, with the same numbers.
"""

import math
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import torch

from groundwork.ranks.ranks import ranks
from scene.cameras import Camera
from scene.readers.info import places
from scene.readers.tracks import PhotoPoints, read_tracks
from scene.reprojection import BOUND, moved_pose, nearest_pose, pose_loss, twist_gradient
from scene.scene import Scene
from splatting.records.training_log import DEGREES, PERCENT
from utils.general_utils import get_expon_lr_func
from utils.graphics_utils import world_to_camera
from utils.system_utils import UserError

# Twists are rotations in radians, and translations in extents of the scene.
_RATES = 1e-4, 1e-6  # of the first and the last step
_PASSES = 10  # over all views, after which drift is taken out: each time the GPU is waited for
_STATE = ("twists", "mean", "square", "counts")


class PoseRefinement:
    """The corrections of a scene's training cameras. `place` gives the cameras their current poses.

    twists: (n, 6) float64, by the cameras' uid.
    """

    def __init__(self, scene: Scene, source_path: str, steps: int) -> None:
        """Begin with the poses of least reprojection error. UserError for a scene without tracks.

        steps: length of the schedule.
        """
        info, unit = scene.info, scene.cameras_extent
        lists = [sorted(of, key=lambda camera: camera.uid) for of in (scene.getTrainCameras(), scene.getTestCameras())]
        self._cameras, count = lists[0] + lists[1], len(lists[0])
        views = info.train_cameras + info.test_cameras
        tracks = read_tracks(source_path, views, info.offset)
        if not any(tracks[:count]):
            raise UserError(
                f"--refine_poses needs a COLMAP model with tracks (2D points of its photos, not of panoramas), and "
                f"{source_path} has none; leave it out"
            )
        given, focals = [_pose_of(camera) for camera in self._cameras], [camera.fx for camera in self._cameras]
        tracked = TrackedPoses(given, tracks, focals, unit)
        drift = _drift(tracked.starts[:count], unit)
        # Another kind of processor may round their solutions in another way.
        self._tracked, self._drift = ranks().broadcast_object((tracked, drift))
        self._given, self._unit = given[:count], unit
        # Rows and translation are those of the enlarged frame, the centre is the world's.
        self._where_drawn = np.repeat((scene.gaussians.enlargement, 1.0), (12, 3))
        self._rate = get_expon_lr_func(*_RATES, max_steps=steps)
        self._adam = BoundedAdam(count)
        self.twists, self._counts = self._adam.values, self._adam.counts
        self._poses: dict[int, np.ndarray] = {}  # that are known
        self._moved: set[int] = set(range(len(views)))  # since `place`
        self.place()
        print(f"--refine_poses corrects {sum(track is not None for track in tracks)} of {len(tracks)} poses")

    def _pose(self, view: int) -> np.ndarray:
        """Return the pose of a view. The number of a training view is its camera's uid; test views follow."""
        if view not in self._poses:
            twist = self.twists[view] if view < len(self.twists) else np.zeros(6)
            self._poses[view] = moved_pose(self._tracked.starts[view], twist, self._unit)
        return self._poses[view]

    def place(self, copy: Camera | None = None) -> None:
        """Give all cameras their current poses; or only one training camera, and a smaller copy of it."""
        views = self._moved.copy() if copy is None else self._moved & {copy.uid}
        for view in views:
            self._place_one(self._cameras[view], view)
        self._moved -= views
        if copy is not None and copy is not self._cameras[copy.uid]:
            self._place_one(copy, copy.uid)

    def _place_one(self, camera: Camera, view: int) -> None:
        pose = self._pose(view)
        camera.place(pose[:3, :3].T.copy(), pose[:3, 3].copy())

    def count_independent(self, uid: int, pending: Sequence[int]) -> int:
        """Count the pending steps, from the last one backwards, that have no effect on the pose of a camera.

        A view can be rendered before these steps are taken, so that the host need not wait for their gradients. A
        camera's pose depends on its own steps, and on the step that takes out the drift of all cameras.

        uid: number of the camera that will be rendered.
        pending: numbers of the cameras whose steps are yet to be taken, in order.
        """
        taken, most, period = int(self._counts.sum()), len(pending), _PASSES * len(self.twists)
        if (taken + len(pending)) // period > taken // period:
            most = (taken + len(pending)) % period
        return min(most, pending[::-1].index(uid)) if uid in pending else most

    def step(self, uid: int, gradient: np.ndarray, step: int) -> None:
        """Take the step of a camera. A camera without a track takes none, because nothing would hold it.

        gradient: gradient of the image's loss by the camera's numbers (diff_gaussian_rasterization/camera.py).
        step: step of the schedule.
        """
        found = np.zeros(6)
        if (pulled := self._tracked.pulled(uid, self.twists[uid])) is not None:
            found = twist_gradient(self._pose(uid), gradient[:15] * self._where_drawn, self._unit) + pulled
        self._adam.step(uid, found, self._rate(step))
        self._move([uid])
        if self._counts.sum() % (_PASSES * len(self.twists)):
            return
        # The scene does not walk, turn or grow: what all cameras could do together is taken out.
        basis, inverse = self._drift
        flat = self.twists.reshape(-1)
        flat -= np.einsum("ak,a->k", basis, np.einsum("ab,b->a", inverse, np.einsum("ak,k->a", basis, flat)))
        self._move(range(len(self.twists)))

    def _move(self, views: Collection[int]) -> None:
        """Forget the poses of views whose twist has changed."""
        for view in views:
            self._poses.pop(view, None)
        self._moved.update(views)

    def corrections(self) -> dict[str, float]:
        """Return the mean change of the dataset's training poses: turn in degrees, shift in percent of the extent."""
        given, now = np.array(self._given), np.array([self._pose(uid) for uid in range(len(self.twists))])
        chords = np.linalg.norm(now[:, :3, :3] - given[:, :3, :3], axis=(1, 2)) / np.sqrt(8)
        centers = [-np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3]) for poses in (now, given)]
        apart = np.linalg.norm(centers[0] - centers[1], axis=1) / self._unit
        turns = np.degrees(2 * np.arcsin(np.minimum(chords, 1)))
        return {DEGREES: round(float(turns.mean()), 6), PERCENT: round(100 * float(apart.mean()), 6)}

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """All numbers that steps change, by name."""
        return dict(zip(_STATE, self._adam.state, strict=True))

    def captured(self) -> dict[str, Any]:
        """Return the state that a resumed training needs, as plain values."""
        return {"names": self._names} | {name: torch.from_numpy(array.copy()) for name, array in self.arrays.items()}

    def restore(self, state: dict[str, Any] | None) -> None:
        """Take the state of `captured()`. Views that the state does not have stay at the dataset's poses.

        UserError for a state that does not fit, or None.
        """
        rows = places(state.get("names"), self._names) if isinstance(state, dict) else None
        shapes = {name: (len(rows or []), *array.shape[1:]) for name, array in self.arrays.items()}
        if not rows or any(getattr(state.get(name), "shape", None) != shape for name, shape in shapes.items()):
            raise UserError(
                "the checkpoint has no refined poses of this run's views; give the scene and the options that it was "
                "trained with, or more photos"
            )
        if "lenses" in state:
            raise UserError("the checkpoint has refined lenses, which are not supported any more; train from the start")
        for name, array in self.arrays.items():
            array[rows] = state[name].numpy()
        self._move(range(len(self._cameras)))

    @property
    def _names(self) -> list[str]:
        return [camera.image_name for camera in self._cameras[: len(self.twists)]]


def _pose_of(camera: Camera) -> np.ndarray:
    return world_to_camera(camera.R, camera.T)


def _drift(poses: list[np.ndarray], unit: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the twists by which all cameras turn, move and grow apart as one, and the inverse of their products.

    The twists are (7, 6 n), the inverse is (7, 7). All are about the cameras' middle, for well-conditioned numbers.
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


_ANCHOR = 1e-3  # weight of each point's squared reprojection error (pixels) in the loss of its view


class TrackedPoses:
    """The poses of views with the least reprojection error. The error, to second order, is a part of the views' loss.

    A start counts as the pose of least error even where the dataset's pose was kept.

    starts: (4, 4) float64 for each view.
    held: curvature of the error by the twist at the start; None for a view without a track, which nothing holds.
    """

    def __init__(
        self, given: Sequence[np.ndarray], tracks: Sequence[PhotoPoints | None], focals: Sequence[float], unit: float
    ) -> None:
        """Find the poses.

        given: the dataset's poses.
        tracks: points that each view shows, or None.
        focals: focal lengths of the views, pixels.
        unit: length of the twists' unit of translation, in world units.
        """
        self.starts, self.held = [], []
        for pose, track, focal in zip(given, tracks, focals, strict=True):
            start = nearest_pose(pose, track, focal, unit, BOUND)
            self.starts.append(start)
            self.held.append(track and pose_loss(start, track, focal, unit).curvature)

    def pulled(self, view: int, twist: np.ndarray) -> np.ndarray | None:
        """Return the gradient of a view's error at a twist; None if the view is not held."""
        curvature = self.held[view]
        return None if curvature is None else _ANCHOR * np.einsum("jk,k->j", curvature, twist)


_BETAS, _EPS = (0.9, 0.99), 1e-12


class BoundedAdam:
    """Twists (n, 6) float64 that begin at 0, with Adam's averages and counts of steps (Kingma and Ba 2015).

    Neither the rotation nor the translation of a twist gets longer than BOUND.
    """

    def __init__(self, count: int) -> None:
        self.values, self.mean, self.square = (np.zeros((count, 6)) for _ in range(3))
        self.counts = np.zeros(count)

    @property
    def state(self) -> tuple[np.ndarray, ...]:
        """All arrays that a resumed training needs."""
        return self.values, self.mean, self.square, self.counts

    def step(self, row: int, gradient: np.ndarray, rate: float) -> None:
        """Take the step of a row. A gradient that is not finite is counted, but changes nothing else."""
        count = self.counts[row] = float(self.counts[row]) + 1
        if not np.isfinite(gradient).all():
            return
        mean = self.mean[row] = _BETAS[0] * self.mean[row] + (1 - _BETAS[0]) * gradient
        square = self.square[row] = _BETAS[1] * self.square[row] + (1 - _BETAS[1]) * gradient**2
        to_mean, to_square = (1 - beta**count for beta in _BETAS)
        values = self.values[row] - rate * (mean / to_mean) / (np.sqrt(square / to_square) + _EPS)
        for part in (slice(3), slice(3, 6)):
            length = math.hypot(*values[part].tolist())
            if length > BOUND:
                values[part] *= BOUND / length
        self.values[row] = values
