"""Depth by the points of structure from motion (--sparse_depth): each photo's own points, where it has seen them.

Sparse points as supervision of depth: Deng et al. 2022 (DS-NeRF), section 3. No network is asked.
"""

from typing import Any

from scene.cameras import Camera
from scene.point_depths import PointDepths, points_of
from scene.readers.tracks import read_tracks
from splatting.iteration import Iteration, Term
from splatting.part import Needs, Part
from utils.system_utils import UserError


class SparseDepth(Part):
    """Adds the depth of a view's points to the view's loss."""

    name = "sparse_depth"
    needs = Needs(depth=True, ranks=False, files=True)

    def begin(self, run: Any, state: Any) -> None:
        """Read the tracks of the training photos. UserError for a scene without tracks."""
        source, self._views = run.dataset.source_path, run.scene.info.train_cameras
        self._options = {"weight": run.opt.sparse_depth, "enlargement": run.gaussians.enlargement}
        self._tracks = read_tracks(source, self._views, run.scene.info.offset)
        self._known: dict[tuple[int, int, int], PointDepths | None] = {}
        if not any(self._tracks):
            raise UserError(
                f"--sparse_depth needs a COLMAP model with tracks (2D points of its photos, not of panoramas), and "
                f"{source} has none; leave it out"
            )

    def terms(self, at: Iteration) -> dict[str, Term]:
        points = self._points_of(at.camera)
        return {"points": lambda package, mask: points.loss(package["depth"], mask)} if points else {}

    def _points_of(self, camera: Camera) -> PointDepths | None:
        """Return the points that train a view, at its size; None if there are none."""
        key = camera.uid, camera.image_width, camera.image_height
        if key not in self._known:
            track = self._tracks[camera.uid]
            self._known[key] = track and points_of(camera, self._views[camera.uid], track, **self._options)
        return self._known[key]
