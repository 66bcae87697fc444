"""The points of structure from motion that training photos have seen, as depths of their views."""

from scene.cameras import Camera
from scene.point_depths import PointDepths, points_of
from scene.readers.tracks import read_tracks
from scene.scene import Scene
from utils.system_utils import UserError


class SeenPoints:
    """The points of all training views. `at` has those of a view at its size."""

    def __init__(self, scene: Scene, source_path: str, weight: float) -> None:
        """UserError for a scene without tracks."""
        self._views, self._weight, self._enlargement = scene.info.train_cameras, weight, scene.gaussians.enlargement
        self._tracks = read_tracks(source_path, self._views, scene.info.offset)
        self._known: dict[tuple[int, int, int], PointDepths | None] = {}
        if not any(self._tracks):
            raise UserError(
                f"--sparse_depth needs a COLMAP model with tracks (2D points of its photos, not of panoramas), and "
                f"{source_path} has none; leave it out"
            )

    def at(self, camera: Camera) -> PointDepths | None:
        """The points that train a view; None if there are none."""
        key = camera.uid, camera.image_width, camera.image_height
        if key not in self._known:
            track = self._tracks[camera.uid]
            options = {"weight": self._weight, "enlargement": self._enlargement}
            self._known[key] = track and points_of(camera, self._views[camera.uid], track, **options)
        return self._known[key]
