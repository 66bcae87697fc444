"""Poses that are trained with the Gaussians (--refine_poses): a bounded correction of each training camera.

Each has Adam of its own. The tracks of structure from motion hold the cameras (tracked_poses.py). All numbers lie on
the host. Of several processes each takes all steps, with the same numbers.
"""

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import torch

from scene.cameras import Camera
from scene.readers.tracks import read_tracks
from scene.reprojection import BOUND, moved_pose, twist_gradient
from scene.scene import Scene
from splatting.distributed.ranks import ranks
from splatting.evaluation.training_log import DEGREES, PERCENT
from splatting.training.bounded_adam import BoundedAdam
from splatting.training.lens_refinement import TOGETHER, LensRefinement
from splatting.training.tracked_poses import TrackedPoses
from utils.general_utils import get_expon_lr_func
from utils.graphics_utils import world_to_camera
from utils.system_utils import UserError

# Twists are rotations in radians, and translations in extents of the scene.
_RATES = 1e-4, 1e-6  # of the first and the last step
_PASSES = 10  # over all views, after which drift is taken out: each time the GPU is waited for
_STATE = ("twists", "mean", "square", "counts")
LENSES = "lenses"  # key of their state


class PoseRefinement:
    """The corrections of a scene's training cameras. `place` gives the cameras their current poses.

    twists (n, 6) float64, by the cameras' uid. lens: the corrections of their lenses, or None.
    """

    def __init__(self, scene: Scene, source_path: str, steps: int, with_lens: bool = False) -> None:
        """steps: of the schedule. UserError for a scene without tracks."""
        info, unit = scene.info, scene.cameras_extent
        lists = [sorted(of, key=lambda camera: camera.uid) for of in (scene.getTrainCameras(), scene.getTestCameras())]
        self._cameras, count = lists[0] + lists[1], len(lists[0])
        views = info.train_cameras + info.test_cameras
        tracks, slopes = read_tracks(source_path, views, info.offset), [None] * len(views)
        if not any(tracks[:count]):
            raise UserError(
                "--refine_poses needs the tracks of a COLMAP model, the places of its points in photos that are no "
                f"panoramas, and {source_path} has none; leave it out"
            )
        given, focals = [_pose_of(camera) for camera in self._cameras], [camera.fx for camera in self._cameras]
        lens = LensRefinement(views, given, tracks, focals, unit) if with_lens else None
        if lens:
            tracks, slopes = lens.tracks, lens.slopes
        tracked = TrackedPoses(given, tracks, focals, slopes, unit)
        drift = _drift(tracked.starts[:count], unit)
        # Another kind of processor may round their solutions in another way.
        self.lens, self._tracked, self._drift = ranks().shared((lens, tracked, drift))
        self._given, self._unit = given[:count], unit
        self._rate = get_expon_lr_func(*_RATES, max_steps=steps)
        self._adam = BoundedAdam(count, (3, 6), BOUND)
        self.twists, self._counts = self._adam.values, self._adam.counts
        self._poses: dict[int, np.ndarray] = {}  # that are known
        self._moved: set[int] = set(range(len(views)))  # since `place`
        self.place()
        lenses = f" and {len(self.lens.seen)} lenses" if self.lens else ""
        print(f"--refine_poses corrects {sum(track is not None for track in tracks)} of {len(tracks)} poses{lenses}")

    def _pose(self, view: int) -> np.ndarray:
        """The pose of a view: of a training camera by its uid; test views follow."""
        if view not in self._poses:
            self._poses[view] = moved_pose(self._tracked.starts[view], self._twist(view), self._unit)
        return self._poses[view]

    def _twist(self, view: int) -> np.ndarray:
        """A test view goes where its track has the least error through the lens of the moment."""
        if view < len(self.twists):
            return self.twists[view]
        return self._tracked.settled(view, self.lens.change(view)) if self.lens else np.zeros(6)

    def place(self, copy: Camera | None = None) -> None:
        """Give all cameras their current poses and lenses; or a training camera, and a smaller copy of it, its own."""
        views = self._moved.copy() if copy is None else self._moved & {copy.uid}
        for view in views:
            self._put(self._cameras[view], view)
        self._moved -= views
        if copy is not None and copy is not self._cameras[copy.uid]:
            self._put(copy, copy.uid)

    def _put(self, camera: Camera, view: int) -> None:
        if self.lens:
            camera.refocus(self.lens.shares(view).tolist())
        pose = self._pose(view)
        camera.place(pose[:3, :3].T.copy(), pose[:3, 3].copy())

    def independent(self, uid: int, pending: Sequence[int]) -> int:
        """On how many of the last steps a camera's next pose does not depend. pending: the cameras of steps to come."""
        taken, most = int(self._counts.sum()), len(pending)
        for period in self._periods:
            if (taken + len(pending)) // period > taken // period:
                most = min(most, (taken + len(pending)) % period)
        return min(most, pending[::-1].index(uid)) if uid in pending else most

    @property
    def _periods(self) -> list[int]:
        """Steps after which drift is taken out, and after which lenses take theirs."""
        return [_PASSES * len(self.twists)] + [TOGETHER] * (self.lens is not None)

    def step(self, uid: int, gradient: np.ndarray, step: int, size: tuple[int, int] = (1, 1)) -> None:
        """Take the step of a camera. step: of the schedule. size: of the image, which its lens needs.

        gradient: of the image's loss by the camera's numbers (diff_gaussian_rasterization/camera.py). A camera without
        a track, which nothing would hold, gets none.
        """
        found, rate = np.zeros(6), self._rate(step)
        moved = np.concatenate([self.twists[uid], self.lens.change(uid)]) if self.lens else self.twists[uid]
        if (pulled := self._tracked.pulled(uid, moved)) is not None:
            found = twist_gradient(self._pose(uid), gradient, self._unit) + pulled[:6]
            if self.lens:
                self.lens.add(uid, gradient, pulled[6:], size)
        self._adam.step(uid, found, rate)
        self._move([uid])
        taken = self._counts.sum()
        if self.lens and taken % TOGETHER == 0:
            self._move(self.lens.step(rate))
        if taken % (_PASSES * len(self.twists)):
            return
        # The scene does not walk, turn or grow: what all cameras could do together is taken out.
        basis, inverse = self._drift
        flat = self.twists.reshape(-1)
        flat -= np.einsum("ak,a->k", basis, np.einsum("ab,b->a", inverse, np.einsum("ak,k->a", basis, flat)))
        self._move(range(len(self.twists)))

    def _move(self, views: Collection[int]) -> None:
        """Forget the poses of views whose twist or lens has changed."""
        for view in views:
            self._poses.pop(view, None)
        self._moved.update(views)

    def corrections(self) -> dict[str, float]:
        """How far training cameras are from the dataset's poses, on the mean: turn, and percent of the extent."""
        given, now = np.array(self._given), np.array([self._pose(uid) for uid in range(len(self.twists))])
        chords = np.linalg.norm(now[:, :3, :3] - given[:, :3, :3], axis=(1, 2)) / np.sqrt(8)
        centers = [-np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3]) for poses in (now, given)]
        apart = np.linalg.norm(centers[0] - centers[1], axis=1) / self._unit
        turns = np.degrees(2 * np.arcsin(np.minimum(chords, 1)))
        return {DEGREES: round(float(turns.mean()), 6), PERCENT: round(100 * float(apart.mean()), 6)}

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """All numbers that steps change, but those of lenses."""
        return dict(zip(_STATE, self._adam.state, strict=True))

    def captured(self) -> dict[str, Any]:
        """State that a resumed training needs, as plain values."""
        state = {"names": self._names, **_tensors(self.arrays)}
        return state | ({LENSES: _tensors(self.lens.state)} if self.lens else {})

    def restore(self, state: dict[str, Any] | None) -> None:
        """Take the state of `captured()`. UserError for one that does not fit, or None."""
        fits = isinstance(state, dict) and state.get("names") == self._names
        if not (fits and _fill(self.arrays, state)):
            raise UserError("the checkpoint has no refined poses of this run's views; leave --refine_poses out")
        if self.lens is None and LENSES in state:
            raise UserError("the checkpoint was trained with --refine_lens; give that option")
        if self.lens and not _fill(self.lens.state, state.get(LENSES)):
            raise UserError("the checkpoint has no refined lenses of this run's cameras; leave --refine_lens out")
        self._move(range(len(self._cameras)))
        self.place()

    @property
    def _names(self) -> list[str]:
        return [camera.image_name for camera in self._cameras[: len(self.twists)]]


def _tensors(arrays: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(array.copy()) for name, array in arrays.items()}


def _fill(arrays: dict[str, np.ndarray], state: Any) -> bool:
    """Give arrays the values of `_tensors`. Returns whether these fit; otherwise nothing changes."""
    if not isinstance(state, dict):
        return False
    if any(getattr(state.get(name), "shape", None) != array.shape for name, array in arrays.items()):
        return False
    for name, array in arrays.items():
        array[:] = state[name].numpy()
    return True


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
