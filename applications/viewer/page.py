"""The page: its server, its tabs and the browsers that watch."""

import argparse
import shlex
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor
from tqdm import tqdm

from applications.viewer import server as servers
from applications.viewer.coverage import Coverage
from applications.viewer.frames import LONGEST, Frames, find_inside
from applications.viewer.legend import Legend
from applications.viewer.measure_tab import MeasureTab, Place
from applications.viewer.path_tab import PathTab
from applications.viewer.photos_tab import ImagesTab
from applications.viewer.tabs import ViewTab, serialize
from applications.viewer.training_tab import Requests
from applications.viewer.views import Pose, SceneCameras, Settings, Vector, read_pose, read_window
from applications.viewer.watchers import Watchers, Wish
from gaussian_renderer.camera_paths.without_scene import WithoutScene
from groundwork.host.interrupt import DeferredInterrupt
from groundwork.host.listing import as_utf8
from groundwork.host.start import typed_command
from scene.gaussian_model import GaussianModel
from scene.scene import Scene
from scene.splats.ply import write_plain_ply
from scene.splats.splats import drawable, selected, tidy
from scene.with_splats import splats_of
from utils.system_utils import UserError, first_line

if TYPE_CHECKING:
    import viser

_SENT = 0.1  # seconds in which a message is sent
_COARSE_QUALITY, _FULL_QUALITY = 70, 95  # of the JPEG
_BETWEEN = 1 / 60  # seconds from frame to frame, at least
_WAIT = 0.5  # seconds until a signal is noticed
_READ = 10.0  # seconds after which a message vanishes
PATHS, CROPS = "camera_paths", "crops"  # in the model's folder, where a browser can write; also the orientation


class Page:
    """A web page that shows the model of a scene. watchers: who looks, and which frame comes next.

    frames: draws them. requests: of its buttons. tabs: the group of tabs, to which others can be added.
    """

    def __init__(
        self,
        port: int,
        scene: Scene | WithoutScene,
        pipe: argparse.Namespace,
        white: bool,
        with_exposures: bool,
        kept: Tensor | None = None,
        untrained: bool = False,
        oriented: str | None = None,
    ) -> None:
        """Start to listen. UserError if that fails. port: 0 for any that is free. white: background, else black.

        kept: (N,) bool, what cleaning leaves.
        untrained: the Gaussians are a scene's points, and the page shows where its cameras stand.
        oriented: the scene's folder, "" without one, if the page may set right how it stands; None: it may not.
        """
        gaussians, folder = scene.gaussians, Path(scene.model_path)
        of_file = isinstance(scene.loaded_iter, str)  # its name
        self._gaussians, self._antialiasing = gaussians, pipe.antialiasing
        self._cameras = SceneCameras(scene.getTrainCameras(), scene.getTestCameras())
        self.frames = Frames(gaussians, self._cameras, pipe, with_exposures)
        self.frames.kept = kept
        if scene.getTrainCameras() and not (of_file or untrained):
            self.frames.coverage = Coverage(scene.getTrainCameras(), self._cameras.size)
        self.watchers = Watchers()
        self.requests = Requests(self.watchers.wake)
        self._faults: dict[int, str] = {}  # of the browsers' last frames
        self._legends: dict[int, viser.GuiHtmlHandle] = {}
        self.server, self.url = servers.serve(port, as_utf8(scene.loaded_iter if of_file else folder.resolve().name))
        gui = self.server.gui
        shown = not (of_file or untrained)
        self.iteration = gui.add_text("Iteration", str(scene.loaded_iter or 0), disabled=True, visible=shown)
        self.count = gui.add_text("Points" if untrained else "Gaussians", f"{len(gaussians):,}", disabled=True)
        self.tabs = gui.add_tab_group()
        # A training adds bands until its end; of a saved model those beyond its last one that is used are all zero.
        photos = not isinstance(scene, WithoutScene)
        degree = gaussians.max_sh_degree if scene.loaded_iter is None else find_used_degree(gaussians)
        with self.tabs.add_tab("View"):
            background = (1.0, 1.0, 1.0) if white else (0.0, 0.0, 0.0)
            calls = self.watchers.note_change, lambda: self.requests.ask(self.export_crop)
            of_model = folder / CROPS, gaussians.get_xyz, degree
            known = kept is not None, photos, self.frames.coverage is not None
            self.view = ViewTab(self.server, *calls, *of_model, background, *known)
        with self.tabs.add_tab("Photos"):
            self.images = ImagesTab(self.server, self.watchers.note_change, self._cameras, untrained, photos)
        with self.tabs.add_tab("Path"):
            self.path = PathTab(self.server, folder / PATHS, self._cameras, self._refuse)
        if untrained or scene.loaded_iter is not None:  # a model that trains moves
            place = None if oriented is None else Place(folder, oriented, gaussians.world_offset)
            with self.tabs.add_tab("Measure"):
                self.measure = MeasureTab(
                    self.server, self._cameras, self._find_point, place, self._report_set, self._refuse
                )
        self.path.saved.on_click(serialize(lambda event: self._save_path(event.client, folder), self._refuse))
        self.server.scene.set_up_direction(tuple(self._cameras.up.tolist()))
        self.server.initial_camera.near = 1e-3 * self._cameras.size
        self.server.initial_camera.far = 1e3 * self._cameras.size
        self.server.on_client_connect(self._add_browser)
        self.server.on_client_disconnect(self._remove_browser)

    # Coroutines, so that viser calls them one after the other: a browser that has left stays away.
    async def _add_browser(self, client: "viser.ClientHandle") -> None:
        """Greet a browser: watch its camera, and draw a first frame for it."""

        async def moved(camera: "viser.CameraHandle") -> None:
            self.images.update_browser(client)
            pose = read_pose(camera)
            if pose is not None:
                self.watchers.update_browser(client.client_id, pose)

        self.path.list_files()
        self._legends[client.client_id] = client.gui.add_html("", order=self.count.order + 0.5, visible=False)
        self.images.frusta.add_browser(client)
        await moved(client.camera)
        client.camera.on_update(moved)

    async def _remove_browser(self, client: "viser.ClientHandle") -> None:
        self.watchers.remove_browser(client.client_id)
        self.images.remove_browser(client.client_id)
        self._legends.pop(client.client_id, None)
        self._faults.pop(client.client_id, None)

    def show_model(self, gaussians: GaussianModel, iteration: int) -> None:
        """Show another model from now on. Called by the thread that draws."""
        self._gaussians = self.frames.gaussians = gaussians
        self.show_numbers(iteration, len(gaussians))

    def settings(self) -> Settings:
        """Read the settings from the controls."""
        return self.images.read(self.view.read())

    def fulfil(self, wish: Wish, version: int = 0) -> None:
        """Draw and send the frame of a wish. One that cannot be drawn ends nothing. version: of the model."""
        try:
            self.watchers.note_drawing(wish, version)
            image, legend = self.frames.draw(self.settings(), wish.pose, wish.coarse, version)
            client = self.server.get_clients().get(wish.client)
            if client is not None:  # it has not left
                self._send_image(client, image, wish.coarse)
                self._explain(wish.client, legend)
            self._faults.pop(wish.client, None)
        except Exception as error:  # memory, an image that is gone
            self._notify_fault(wish.client, first_line(error))

    @staticmethod
    def _send_image(client: "viser.ClientHandle", image: np.ndarray, coarse: bool) -> None:
        """Send an image (H, W, 3) uint8 to a browser. coarse: true for one of a moving camera."""
        if not coarse and max(image.shape) <= LONGEST // 2:
            image = image.repeat(2, axis=0).repeat(2, axis=1)  # JPEG halves the resolution of colours
        quality = _COARSE_QUALITY if coarse else _FULL_QUALITY
        client.scene.set_background_image(image, "jpeg", jpeg_quality=quality)

    def _refuse(self, client: "viser.ClientHandle", error: UserError) -> None:
        self._notify(client, "Not done", str(error), color="red")

    def _explain(self, client: int, legend: Legend) -> None:
        shown, text = self._legends.get(client), legend.make_html()
        if shown is not None and shown.content != text:
            shown.content, shown.visible = text, bool(text)

    def _notify_fault(self, client: int, fault: str) -> None:
        """Tell a browser, once, why its frame could not be drawn."""
        if fault != self._faults.get(client):
            self._faults[client] = fault
            tqdm.write(f"warning: the viewer could not draw a frame ({fault})", file=sys.stderr)
            self._notify(self.server.get_clients().get(client), "No picture", fault, color="red")

    @staticmethod
    def _notify(client: "viser.ClientHandle | None", title: str, body: str, **look: Any) -> None:
        """Show a message to a browser, unless it has left."""
        if client is not None:
            client.add_notification(title, as_utf8(body), auto_close_seconds=_READ, **look)

    def show_numbers(self, iteration: int, gaussians: int, of: str = "") -> None:
        """Show the iteration, of how many it is, such as " of 7,000", and the number of Gaussians."""
        self.iteration.value, self.count.value = f"{iteration:,}{of}", f"{gaussians:,}"

    def notify(self, title: str, body: str, **look: Any) -> None:
        """Show a notification to all, and wait until it has probably been sent."""
        clients = self.server.get_clients().values()
        for client in clients:
            self._notify(client, title, body, **look)
            client.flush()
        if clients:
            time.sleep(_SENT)

    def export_crop(self) -> None:
        """Write the Gaussians in the crop box into the model's folder. Called by the thread that changes the model."""
        name = self.view.crop_file
        try:
            file, replaced = name.path(), name.replaced()
            count = write_crop(file, self._gaussians, self.view.corners(), self._antialiasing)
        except Exception as error:  # as for a frame; a full disk
            tqdm.write(f"warning: the crop is not exported ({first_line(error)})", file=sys.stderr)
            self.notify("Not exported", first_line(error), color="red")
        else:
            what = f"{count:,} of {len(self._gaussians):,} Gaussians"
            tqdm.write(as_utf8(f"Exported {what} to {file}{replaced}"), file=sys.stdout)
            self.notify("Exported", f"{what}: {CROPS}/{file.name}{replaced}")
            name.suggest()

    def _find_point(self, pose: Pose, ray: np.ndarray, found: Callable[[np.ndarray | None], None]) -> None:
        """Find the point on the surface along a ray from a pose, between two frames.

        ray: (3,), in the world.
        found: called with the point (3,), or None where there is no surface.
        """

        def ask() -> None:
            point = None
            try:
                point = self.frames.surface(self.settings(), pose, ray)
            except Exception as error:  # as for a frame
                self.notify("No point", first_line(error), color="red")
            found(point)

        self.requests.ask(ask)

    def _report_set(self, client: "viser.ClientHandle", what: str, files: list[Path]) -> None:
        """Print and show which files a change of scale, upright or front was written into."""
        names = " and ".join(map(str, files))
        tqdm.write(as_utf8(f"{what}; written into {names}"), file=sys.stdout)
        self._notify(client, what, f"exports of this scene follow it from now on: {names}")

    def _save_path(self, client: "viser.ClientHandle", folder: Path) -> None:
        """Save the camera path, and show how to make its video. folder: of the model."""
        replaced, file = self.path.file.replaced(), self.path.save()
        size = (max(2, side - side % 2) for side in read_window(client.camera))
        words = shlex.join(map(str, ("-m", folder, "--path", file, "--size", *size)))
        tqdm.write(as_utf8(f"Saved {file}{replaced}; its video: {typed_command('render.py')} {words}"), file=sys.stdout)
        self._notify(client, "Saved", f"{PATHS}/{file.name}{replaced}; the terminal shows how to make its video")

    def stop(self) -> None:
        """Stop listening."""
        self.path.stop()
        servers.stop(self.server)


def find_used_degree(gaussians: GaussianModel) -> int:
    """The highest SH degree of which a coefficient is not zero."""
    used = gaussians.get_features_rest.detach().any(0).any(1).nonzero()
    return int((int(used.max()) + 1) ** 0.5) if len(used) else 0


def write_crop(path: Path, gaussians: GaussianModel, box: tuple[Vector, Vector], antialiasing: bool) -> int:
    """Write the Gaussians in a box, given by opposite corners; return their number. UserError without any."""
    part = gaussians.part(find_inside(gaussians.get_xyz, *box), gaussians.active_sh_degree)
    splats = splats_of(part, antialiasing)
    splats = tidy(selected(splats, drawable(splats)))
    if not len(splats):
        raise UserError("the crop box has no Gaussians; move its corners")
    write_plain_ply(path, splats)
    return len(splats)


def serve(page: Page) -> type[KeyboardInterrupt] | None:
    """Draw frames and do what buttons ask for, until a browser closes the page or Ctrl-C or SIGTERM comes.

    Return the exception that the signal stands for; None if a browser closed the page.
    """
    with DeferredInterrupt() as interrupt:
        while not interrupt.requested and not page.requests.stopped:
            answer(page)
    return interrupt.requested


def answer(page: Page) -> bool:
    """Do what a button asked for, draw and send the next frame that somebody waits for, or wait a little.

    Returns True if there was a frame.
    """
    page.requests.work()
    wish = page.watchers.next()
    if wish is None:
        page.watchers.wait(_WAIT if not page.watchers.any else _BETWEEN)
        return False
    began = time.perf_counter()
    page.fulfil(wish)
    time.sleep(max(0.0, began + _BETWEEN - time.perf_counter()))
    return True
