"""The tab of the scene's cameras and their photos."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from applications.viewer import views
from applications.viewer.divider import Divider
from applications.viewer.frusta import Frusta
from applications.viewer.tabs import serialize
from applications.viewer.views import SceneCameras, Settings
from gaussian_renderer.camera_paths.poses import vertical_fov
from gaussian_renderer.camera_paths.start import narrow_fov
from utils.graphics_utils import camera_center

if TYPE_CHECKING:
    import viser


class ImagesTab:
    """Controls for the scene's cameras. changed(dragging): called when what is shown changes.

    all_drawn: browsers begin with all cameras drawn and in view. photos: whether the cameras have any.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        changed: Callable[[bool], None],
        cameras: SceneCameras,
        all_drawn: bool,
        photos: bool,
    ) -> None:
        """Put the controls into the current tab of the server.

        changed: called when the picture changes, with true while the slider may go on moving.
        all_drawn: true if pyramids of all cameras are drawn at first, and browsers begin with a view of all.
        photos: true if the cameras have photos.
        """
        gui, self._server, self._cameras, self._all_drawn = server.gui, server, cameras, all_drawn
        self.frusta = Frusta(cameras, self._choose, all_drawn)
        self._divider = Divider(cameras.size, self._drag)
        names = tuple(cameras.by_name)
        self.camera = gui.add_dropdown(
            "Camera", names, initial_value=cameras.start or None, hint="the view jumps there"
        )
        again = gui.add_button("Go to the camera")
        hint = "shown while the view is that of the chosen camera" if photos else "there are no photos"
        self.comparison = gui.add_dropdown("Compare", views.COMPARISONS, hint=hint, disabled=not photos)
        self.slider = gui.add_slider("Slider", 0.0, 1.0, 0.005, 0.5, hint="0: render, 1: photo", visible=False)
        shown = gui.add_checkbox("Draw cameras", all_drawn, hint="a click on one jumps there; those near the view fade")
        colours = gui.add_markdown("Training views are blue, test views orange.", visible=all_drawn)
        self._windows: dict[int, tuple[int, int]] = {}  # of browsers, to which their opening angles fit
        self._set_beginning()
        # In turn, so that the view does not get its place from one camera and its direction from the next.
        self.camera.on_update(serialize(lambda event: (self._set_beginning(), self.move_to_camera(event.client))))
        again.on_click(serialize(lambda event: self.move_to_camera(event.client)))
        self.comparison.on_update(serialize(lambda event: (self._compare(event.client), changed(False))))
        self.slider.on_update(serialize(lambda _: (self._draw_divider(), changed(True))))
        shown.on_update(serialize(lambda _: (self.frusta.show(shown.value), setattr(colours, "visible", shown.value))))

    def read(self, settings: Settings) -> Settings:
        """Add the settings of these controls."""
        return replace(settings, camera=self.camera.value, comparison=self.comparison.value, slider=self.slider.value)

    def _set_beginning(self) -> None:
        """Let browsers that come from now on begin at the chosen camera, or where all are in view."""
        camera, initial = self._cameras.by_name.get(self.camera.value), self._server.initial_camera
        if camera is None:
            return
        place, axes, up = camera_center(camera.R, camera.T), np.asarray(camera.R), self._cameras.up_at(camera.R)
        target, fov = self._cameras.target_of(place, axes), vertical_fov(camera)
        if self._all_drawn:
            place, axes, target = self._cameras.overview()
            up, fov = self._cameras.up, views.overview_fov(1.0)
        initial.position, initial.look_at, initial.up, initial.fov = place, target, tuple(up), fov
        self._beginning = place, axes

    def update_browser(self, client: "viser.ClientHandle") -> None:
        """Follow a browser whose camera has moved, or whose window has another size."""
        self._fit_angle(client)
        self._draw_divider()
        self.frusta.update_browser(client)

    def _fit_angle(self, client: "viser.ClientHandle") -> None:
        """Fit the opening angle to a browser's window if that is new or has changed, and the camera has not moved."""
        camera, pose = self._cameras.by_name.get(self.camera.value), views.read_pose(client.camera)
        if camera is None or pose is None or not self._cameras.stands_at(pose, *self._beginning):
            return
        window, before = (pose.width, pose.height), self._windows.get(client.client_id)
        self._windows[client.client_id] = window
        if window == before:
            return
        aspect = pose.width / pose.height
        if self._all_drawn:
            client.camera.fov = views.overview_fov(aspect)
        elif self.comparison.value == views.ALONE:
            client.camera.fov = narrow_fov(vertical_fov(camera), camera.image_width / camera.image_height, aspect)
        else:
            client.camera.fov = views.fit_fov(camera, aspect)

    def remove_browser(self, client: int) -> None:
        """Forget a browser that has gone."""
        self.frusta.remove_browser(client)
        self._divider.remove_browser(client)
        self._windows.pop(client, None)

    def _draw_divider(self) -> None:
        """Draw the line between photo and render for those who see both."""
        camera, slides = self._cameras.by_name.get(self.camera.value), self.comparison.value == views.SLIDER
        for client in self._server.get_clients().values():
            pose = views.read_pose(client.camera)
            there = slides and pose is not None and camera is not None and self._cameras.stands_at_camera(pose, camera)
            self._divider.place(client, camera if there else None, self.slider.value)

    def _drag(self, share: float) -> None:
        self.slider.value = share

    def _compare(self, client: "viser.ClientHandle | None") -> None:
        self.slider.visible = self.comparison.value == views.SLIDER
        if self.comparison.value != views.ALONE:
            self.move_to_camera(client)
        self._draw_divider()

    def move_to_camera(self, client: "viser.ClientHandle | None") -> None:
        """Move a browser's camera to the chosen one."""
        camera = self._cameras.by_name.get(self.camera.value)
        if client is not None and camera is not None:
            width, height = views.read_window(client.camera)
            place, fov = camera_center(camera.R, camera.T), views.fit_fov(camera, width / height)
            self._cameras.move(client, place, np.asarray(camera.R), fov)

    def _choose(self, event: Any, name: str) -> None:
        self.camera.value = name
        self.move_to_camera(event.client)
