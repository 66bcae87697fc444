"""The line between photo and render, which each browser can drag."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from applications.viewer.views import read_window
from gaussian_renderer.camera_paths.poses import vertical_fov
from scene.cameras import Camera
from utils.graphics_utils import camera_center

if TYPE_CHECKING:
    import viser

_AWAY = 0.02  # of the scene's size, from the browser's camera
_KNOB, _LINE = 0.035, 0.004  # radius of the knob and half the width of the line, by half the photo's height
_NAME = "/divider"


def _make_shape() -> tuple[np.ndarray, np.ndarray]:
    """Corners and faces of a line of height 2 with a round knob in its middle."""
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    circle = _KNOB * np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])
    line = np.array([[x, y, 0] for x, y in ((-_LINE, -1), (_LINE, -1), (_LINE, 1), (-_LINE, 1))])
    fan = [[4, 4 + n, 5 + n] for n in range(1, len(circle) - 1)]
    return np.vstack([line, circle]).astype(np.float32), np.uint32([[0, 1, 2], [0, 2, 3], *fan])


class Divider:
    """Draws the line for each browser. size: of the scene. dragged: called with the photo's share of the width.

    Called by the server's thread alone.
    """

    def __init__(self, size: float, dragged: Callable[[float], None]) -> None:
        self._away, self._dragged = _AWAY * size, dragged
        self._drawn: dict[int, viser.MeshHandle] = {}
        self._cameras: dict[int, Camera] = {}

    def place(self, client: "viser.ClientHandle", camera: Camera | None, share: float) -> None:
        """Draw the line into what a browser sees from a camera. None: it does not see a photo."""
        drawn = self._drawn.get(client.client_id)
        if camera is None:
            if drawn is not None:
                drawn.visible = False
            return
        if drawn is None:
            drawn = self._drawn[client.client_id] = client.scene.add_mesh_simple(
                _NAME, *_make_shape(), color=(255, 255, 255), side="double", cast_shadow=False, receive_shadow=False
            )
            drawn.on_drag(self._follow_drag)
        from viser.transforms import SO3

        self._cameras[client.client_id] = camera
        turn, slope = np.asarray(camera.R), np.tan(vertical_fov(camera) / 2)
        across = (2 * share - 1) * slope * camera.image_width / camera.image_height
        drawn.position = camera_center(camera.R, camera.T) + self._away * (turn[:, 2] + across * turn[:, 0])
        drawn.wxyz, drawn.scale, drawn.visible = SO3.from_matrix(turn).wxyz, self._away * slope, True

    async def _follow_drag(self, event: Any) -> None:
        """Tell the page where a browser has dragged the line to, as a share of the frame's width."""
        camera = self._cameras.get(event.client_id)
        if camera is not None:
            self._dragged(find_share(event.end_screen_pos[0], camera, *read_window(event.client.camera)))

    def remove_browser(self, client: int) -> None:
        """Forget a browser that has gone."""
        self._drawn.pop(client, None)
        self._cameras.pop(client, None)


def find_share(across: float, camera: Camera, width: int, height: int) -> float:
    """Return the share of a photo's width that is left of a place in a window that shows the whole photo.

    across: of the place, 0 to 1 from the window's left edge.
    """
    shown = max(1.0, width / height * camera.image_height / camera.image_width)  # width, by that of the photo
    return min(max((across - 0.5) * shown + 0.5, 0.0), 1.0)
