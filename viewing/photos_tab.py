"""The tab with the scene's cameras: jump to one, and compare its photo with the render."""

import contextlib
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from viewing.in_turn import in_turn
from viewing.poses import window_of
from viewing.scene_cameras import SceneCameras, center, fov_of_canvas
from viewing.settings import COMPARISONS, Settings

if TYPE_CHECKING:
    import viser

_MOST = 200  # cameras that are drawn
_COLOURS = {"train": (60, 120, 220), "test": (220, 100, 40)}
_DRAWN_SIZE = 0.06  # of a drawn camera, by the scene's size


class PhotosTab:
    """Controls for the scene's cameras. changed(dragging): called when what is shown changes."""

    def __init__(self, server: "viser.ViserServer", changed: Callable[[bool], None], cameras: SceneCameras) -> None:
        gui, self._server, self._cameras = server.gui, server, cameras
        names = tuple(cameras.by_name)
        self.camera = gui.add_dropdown("Camera", names, hint="the view jumps there")
        again = gui.add_button("Go to the camera again")
        self.comparison = gui.add_dropdown(
            "Compare", COMPARISONS, hint="shown while the view is that of the chosen camera"
        )
        self.slider = gui.add_slider("Photo's share", 0.0, 1.0, 0.005, 0.5)
        shown = gui.add_checkbox("Draw cameras", False, hint="a click on one jumps there")
        self._drawn = server.scene.add_frame("/cameras", show_axes=False, visible=False)
        self._draw()
        # In turn, so that the view does not get its place from one camera and its direction from the next.
        self.camera.on_update(in_turn(lambda event: self.go(event.client, self.camera.value)))
        again.on_click(in_turn(lambda event: self.go(event.client, self.camera.value)))
        self.comparison.on_update(in_turn(lambda event: (self.go(event.client, self.camera.value), changed(False))))
        self.slider.on_update(lambda _: changed(True))
        shown.on_update(lambda _: setattr(self._drawn, "visible", shown.value))

    def read(self, settings: Settings) -> Settings:
        """The settings, with what these controls say."""
        return replace(settings, camera=self.camera.value, comparison=self.comparison.value, slider=self.slider.value)

    def go(self, client: "viser.ClientHandle | None", name: str) -> None:
        """Move a browser's camera to one of the scene."""
        camera = self._cameras.by_name.get(name)
        if client is None or camera is None:
            return
        place, (width, height) = center(camera), window_of(client.camera)
        with client.atomic():
            with contextlib.suppress(ValueError):  # of a browser that says that it looks at its own place
                client.camera.position = place
            client.camera.look_at = place + camera.R[:, 2] * self._cameras.depth(camera)
            client.camera.up_direction = self._cameras.up_at(camera)
            client.camera.fov = fov_of_canvas(camera, width / height)

    def _draw(self) -> None:
        from viser.transforms import SO3

        names = list(self._cameras.by_name)
        for index, name in enumerate(names[:: -(-len(names) // _MOST) or 1]):
            camera = self._cameras.by_name[name]
            frustum = self._server.scene.add_camera_frustum(
                f"/cameras/{index}",
                fov=camera.FoVy,
                aspect=camera.image_width / camera.image_height,
                scale=_DRAWN_SIZE * self._cameras.size,
                color=_COLOURS[name.split()[0]],
                wxyz=SO3.from_matrix(np.asarray(camera.R)).wxyz,
                position=center(camera),
                cast_shadow=False,
                receive_shadow=False,
            )
            frustum.on_click(in_turn(lambda event, name=name: self._choose(event.client, name)))

    def _choose(self, client: "viser.ClientHandle", name: str) -> None:
        self.camera.value = name
        self.go(client, name)
