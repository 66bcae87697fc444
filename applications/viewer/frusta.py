"""The scene's cameras as each browser draws them. Cameras near its own fade, as they would fill its window."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from applications.viewer.views import SceneCameras
from utils.graphics_utils import camera_center

if TYPE_CHECKING:
    import viser

_MOST = 200  # cameras that are drawn
_COLOURS = {"train": (0, 80, 255), "test": (255, 90, 0)}
_LENGTH = 0.06  # of a drawn camera, by the scene's size
_WIDEST = 1.0  # of its half width and height, by its length: what fisheyes and panoramas are drawn as
_GONE, _WHOLE = 2.0, 8.0  # lengths of a drawn camera from the browser's: up to here it is not drawn, from here whole
_SHADES = 8  # between them, so that a browser gets a message for each of these alone
_NAME = "/cameras"
_APEX_AND_CORNERS = np.float32([[0, 0, 0], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]])
# Closed, with its faces to the outside, so that viser's highlight of a camera lies behind them and takes no click.
_FACES = np.uint32([[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4], [1, 2, 3], [1, 3, 4]])


def fade_opacities(distances: np.ndarray) -> np.ndarray:
    """Opacities (N,) in [0, 1] of drawn cameras, by their distances in lengths of a drawn camera."""
    return np.round(np.clip((distances - _GONE) / (_WHOLE - _GONE), 0, 1) * _SHADES) / _SHADES


class Frusta:
    """Up to 200 of the scene's cameras, drawn for each browser, if they are visible.

    chosen: called with a click's event and the name. Called by the server's thread alone.
    """

    def __init__(self, cameras: SceneCameras, chosen: Callable[[Any, str], None], visible: bool) -> None:
        """Prepare pyramids of the cameras, of many only some.

        chosen: called with the event of a click and the name of the clicked camera.
        visible: true if they are drawn at first.
        """
        from viser.transforms import SO3

        names = list(cameras.by_name)
        self.names = names[:: -(-len(names) // _MOST) or 1]
        some = [cameras.by_name[name] for name in self.names]
        self._length = _LENGTH * cameras.size
        self._places = np.array([camera_center(camera.R, camera.T) for camera in some]).reshape(-1, 3)
        tangents = [(np.tan(camera.FoVx / 2), np.tan(camera.FoVy / 2), 1.0) for camera in some]
        self._sizes = self._length * np.array(tangents).clip(max=_WIDEST).reshape(-1, 3)
        self._turns = np.array([SO3.from_matrix(np.asarray(camera.R)).wxyz for camera in some]).reshape(-1, 4)
        self._colours = np.uint8([_COLOURS[name.split()[0]] for name in self.names]).reshape(-1, 3)
        self._drawn: dict[int, viser.BatchedMeshHandle] = {}
        self._chosen = chosen
        self._visible = visible

    def add_browser(self, client: "viser.ClientHandle") -> None:
        """Draw the cameras for a browser."""
        if not self.names:
            return
        opacities = self._compute_opacities(client.camera.position)
        drawn = self._drawn[client.client_id] = client.scene.add_batched_meshes_simple(
            _NAME, _APEX_AND_CORNERS, _FACES, self._turns, self._places,
            batched_scales=self._compute_scales(opacities), batched_colors=self._colours, batched_opacities=opacities,
            lod="off", wireframe=True, side="double", cast_shadow=False, receive_shadow=False, visible=self._visible,
        )  # fmt: skip
        drawn.on_click(self._take_click)

    async def _take_click(self, event: Any) -> None:
        """Tell the page which camera was clicked."""
        if event.instance_index in range(len(self.names)):
            self._chosen(event, self.names[event.instance_index])

    def update_browser(self, client: "viser.ClientHandle") -> None:
        """Fade what is near the camera of a browser."""
        drawn = self._drawn.get(client.client_id)
        opacities = self._compute_opacities(client.camera.position)
        if drawn is not None and not np.array_equal(opacities, drawn.batched_opacities):
            with client.atomic():
                drawn.batched_opacities, drawn.batched_scales = opacities, self._compute_scales(opacities)

    def remove_browser(self, client_id: int) -> None:
        """Forget a browser that has gone."""
        self._drawn.pop(client_id, None)

    def show(self, visible: bool) -> None:
        """Show the drawn cameras to all, or hide them."""
        self._visible = visible
        for drawn in self._drawn.values():
            drawn.visible = visible

    def _compute_opacities(self, position: np.ndarray) -> np.ndarray:
        """Return the opacity (N,) of each camera as seen from a position (3,): near ones fade."""
        return fade_opacities(np.linalg.norm(self._places - position, axis=1) / self._length).astype(np.float32)

    def _compute_scales(self, opacities: np.ndarray) -> np.ndarray:
        """Sizes (N, 3); one that cannot be seen has none, so that no click meets it."""
        return np.where(opacities[:, None] > 0, self._sizes, 0.0).astype(np.float32)
