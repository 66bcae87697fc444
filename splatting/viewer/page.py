"""The page: its server, its tabs and the browsers that watch; and the page of a saved model."""

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from scene.scene import Scene
from splatting.host.interrupt import DeferredInterrupt
from splatting.viewer import server as servers
from splatting.viewer.frames import LONGEST, Frames
from splatting.viewer.server import Address
from splatting.viewer.tabs import ImagesTab, PathTab, ViewTab
from splatting.viewer.views import SceneCameras, Settings, as_utf8, pose_of
from splatting.viewer.watchers import Watchers, Wish
from utils.graphics_utils import camera_center
from utils.system_utils import first_line

if TYPE_CHECKING:
    import viser

_SENT = 0.1  # seconds in which a message is sent
_COARSE_QUALITY, _FULL_QUALITY = 70, 95  # of the JPEG
_BETWEEN = 1 / 60  # seconds from frame to frame, at least
_WAIT = 0.5  # seconds until a signal is noticed


class Page:
    """A web page that shows the model of a scene. watchers: who looks, and which frame comes next.

    tabs: the group of tabs, to which others can be added.
    """

    def __init__(
        self, address: Address, scene: Scene, pipe: argparse.Namespace, white: bool, with_exposures: bool
    ) -> None:
        """Start to listen. UserError if that cannot be done. white: the background at first, else black."""
        gaussians = scene.gaussians
        self._cameras = SceneCameras(scene.getTrainCameras(), scene.getTestCameras())
        self._frames = Frames(gaussians, self._cameras, pipe, with_exposures)
        self.watchers = Watchers()
        self._fault = ""  # the last one that was shown
        self.server, self.url = servers.serve(address, as_utf8(Path(scene.model_path).resolve().name))
        gui = self.server.gui
        self.iteration = gui.add_text("Iteration", str(scene.loaded_iter or 0), disabled=True)
        self.count = gui.add_text("Gaussians", f"{len(gaussians):,}", disabled=True)
        self.tabs = gui.add_tab_group()
        positions, degree = gaussians.get_xyz, gaussians.max_sh_degree
        with self.tabs.add_tab("View"):
            background = (1.0, 1.0, 1.0) if white else (0.0, 0.0, 0.0)
            self.view = ViewTab(self.server, self.watchers.changed, positions, degree, background)
        with self.tabs.add_tab("Photos"):
            self.images = ImagesTab(self.server, self.watchers.changed, self._cameras)
        with self.tabs.add_tab("Path"):
            self.path = PathTab(self.server, Path(scene.model_path))
        self._begin_at_first_camera()
        self.server.on_client_connect(self._came)
        self.server.on_client_disconnect(self._left)

    def _begin_at_first_camera(self) -> None:
        self.server.scene.set_up_direction(tuple(self._cameras.up.tolist()))
        camera, initial = next(iter(self._cameras.by_name.values()), None), self.server.initial_camera
        if camera is not None:
            initial.position = place = camera_center(camera.R, camera.T)
            initial.look_at = place + camera.R[:, 2] * self._cameras.depth(camera)
            initial.up = self._cameras.up_at(camera)
            initial.fov = camera.FoVy
        initial.near, initial.far = 1e-3 * self._cameras.size, 1e3 * self._cameras.size

    # Coroutines, so that viser calls them one after the other: a browser that has left stays away.
    async def _came(self, client: "viser.ClientHandle") -> None:
        async def moved(camera: "viser.CameraHandle") -> None:
            pose = pose_of(camera)
            if pose is not None:
                self.watchers.moved(client.client_id, pose)

        await moved(client.camera)
        client.camera.on_update(moved)

    async def _left(self, client: "viser.ClientHandle") -> None:
        self.watchers.left(client.client_id)

    def settings(self) -> Settings:
        """What the controls say now."""
        return self.images.read(self.view.read())

    def fulfil(self, wish: Wish, version: int = 0) -> None:
        """Draw and send the frame of a wish. One that cannot be drawn ends nothing. version: of the model."""
        try:
            self.watchers.drew(wish, version)
            image = self._frames.draw(self.settings(), wish.pose, wish.coarse, version)
            client = self.server.get_clients().get(wish.client)
            if client is not None:  # it has not left
                self._send(client, image, wish.coarse)
        except Exception as error:  # memory, an image that is gone
            self._notify_fault(wish, first_line(error))

    @staticmethod
    def _send(client: "viser.ClientHandle", image: np.ndarray, coarse: bool) -> None:
        if not coarse and max(image.shape) <= LONGEST // 2:
            image = image.repeat(2, axis=0).repeat(2, axis=1)  # JPEG halves the resolution of colours
        quality = _COARSE_QUALITY if coarse else _FULL_QUALITY
        client.scene.set_background_image(image, "jpeg", jpeg_quality=quality)

    def _notify_fault(self, wish: Wish, fault: str) -> None:
        if fault == self._fault:
            return
        self._fault = fault
        tqdm.write(f"warning: the viewer could not draw a frame ({fault})", file=sys.stderr)
        client = self.server.get_clients().get(wish.client)
        if client is not None:
            client.add_notification("No picture", as_utf8(fault), color="red")

    def show_numbers(self, iteration: int, gaussians: int) -> None:
        """Show the iteration and the number of Gaussians."""
        self.iteration.value, self.count.value = f"{iteration:,}", f"{gaussians:,}"

    def notify(self, title: str, body: str) -> None:
        """Show a notification to all, and wait until it has probably been sent."""
        clients = self.server.get_clients().values()
        for client in clients:
            client.add_notification(title, as_utf8(body))
            client.flush()
        if clients:
            time.sleep(_SENT)

    def stop(self) -> None:
        """Stop to listen."""
        servers.stop(self.server)


def serve_saved(address: Address, scene: Scene, pipe: argparse.Namespace, white: bool, with_exposures: bool) -> None:
    """Serve the page until a signal comes, and raise that. white, with_exposures: as for `Page`."""
    page = Page(address, scene, pipe, white, with_exposures)
    try:
        with DeferredInterrupt() as interrupt:
            while not interrupt.requested:
                answer(page)
        raise interrupt.requested
    finally:
        page.stop()


def answer(page: Page) -> bool:
    """Draw and send the next frame that somebody waits for, or wait a little. Whether there was one."""
    wish = page.watchers.next()
    if wish is None:
        page.watchers.wait(_WAIT if not page.watchers.any else _BETWEEN)
        return False
    began = time.perf_counter()
    page.fulfil(wish)
    time.sleep(max(0.0, began + _BETWEEN - time.perf_counter()))
    return True
