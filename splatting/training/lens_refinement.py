"""Lenses that are trained with the poses (--refine_lens): a bounded correction of each camera of the model.

Its photos share it. They start with the lens that fits their tracks best, together with their poses. A lens takes a
step after several of training, with the mean of their gradients, so that a host need not wait for a GPU in each.
"""

from collections.abc import Sequence

import numpy as np
from diff_gaussian_rasterization.lens import Lens

from scene.lens_correction import ENDS, allowed, corrected, lens_gradient, lens_of, ray_slopes, shares_of
from scene.readers.info import CameraInfo
from scene.readers.tracks import Track
from scene.reprojection import BOUND, Seen, nearest_change
from splatting.training.bounded_adam import BoundedAdam

TOGETHER = 16  # steps of training to one of the lenses
STATE = ("values", "mean", "square", "counts", "sums", "seen")


class LensRefinement:
    """The corrections of the cameras of views, which are counted in the order that is given.

    tracks: with rays through the lenses that training starts with. slopes: of these rays (`ray_slopes`).
    """

    def __init__(
        self,
        views: Sequence[CameraInfo],
        poses: Sequence[np.ndarray],
        tracks: Sequence[Track | None],
        focals: Sequence[float],
        unit: float,
    ) -> None:
        """poses, tracks: of the views. focals: of their images, pixels. unit: of translations."""
        ids = list(dict.fromkeys(view.uid for view in views))
        self._cameras = np.array([ids.index(view.uid) for view in views])
        self._native = [view.native is not None for view in views]
        lenses = [lens_of(view) for view in views]
        self._allowed = [allowed(lenses[int(np.argmax(self._cameras == row))]) for row in range(len(ids))]
        seen = [
            track and Seen(pose, track, focal, ray_slopes(lens, track.rays))
            for pose, track, focal, lens in zip(poses, tracks, focals, lenses, strict=True)
        ]
        starts = [
            nearest_change([seen[at] for at in np.flatnonzero(self._cameras == row) if seen[at]], unit, onto)
            for row, onto in enumerate(self._allowed)
        ]
        changes = [starts[row] for row in self._cameras]
        self._starts = [corrected(shares_of(view), change) for view, change in zip(views, changes, strict=True)]
        self.tracks = [one and one.track_after(change) for one, change in zip(seen, changes, strict=True)]
        self.slopes = [
            one and (ray_slopes(_after(lens, change), track.rays) if change.any() else one.slopes)
            for one, lens, change, track in zip(seen, lenses, changes, self.tracks, strict=True)
        ]
        self._adam = BoundedAdam(len(ids), ENDS, BOUND)
        self.sums, self.seen = np.zeros_like(self._adam.values), np.zeros(len(ids))

    @property
    def state(self) -> dict[str, np.ndarray]:
        """All arrays, which a resumed training needs."""
        return dict(zip(STATE, (*self._adam.state, self.sums, self.seen), strict=True))

    def change(self, view: int) -> np.ndarray:
        """The change (15,) of a view's lens since the start."""
        return self._adam.values[self._cameras[view]]

    def shares(self, view: int) -> np.ndarray:
        """The values (15,) of a view's lens, as `shares_of` has them."""
        return corrected(self._starts[view], self.change(view))

    def add(self, view: int, numbers: np.ndarray, pulled: np.ndarray, size: tuple[int, int]) -> None:
        """Keep the gradients of a step: of the image by the camera's numbers, and of the tracks (15,). size: image."""
        focal = self.shares(view)[:2] * size
        found = lens_gradient(numbers, focal, self.change(view), self._native[view]) + pulled
        if np.isfinite(found).all():
            self.sums[self._cameras[view]] += found
            self.seen[self._cameras[view]] += 1

    def step(self, rate: float) -> list[int]:
        """Take the steps of all lenses that were seen since the last ones. Returns the views that have changed."""
        rows = np.flatnonzero(self.seen)
        for row in rows:
            self._adam.step(row, self._allowed[row] @ (self.sums[row] / self.seen[row]), rate)
        self.sums[:], self.seen[:] = 0, 0
        return np.flatnonzero(np.isin(self._cameras, rows)).tolist()


def _after(lens: Lens, change: np.ndarray) -> Lens:
    return lens.with_values(corrected(np.array(lens.values), change).tolist())
