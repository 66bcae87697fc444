"""The remote viewer of the reference (--ip, --port, --disable_viewer), by gaussian_renderer/network_gui.py."""

import argparse
from typing import Any

import torch
from torch import Tensor

from arguments.features import FEATURES
from gaussian_renderer import network_gui, render
from gaussian_renderer.network_message import Request
from gaussian_renderer.network_transfer import ViewerLost
from scene.gaussian_model import GaussianModel
from splatting.iteration import Iteration, Losses
from splatting.part import Error, Part
from utils.system_utils import first_line

_TICK = 0.1  # seconds between looks whether a signal asks to stop
_LAST = 1.0  # seconds that a finished training waits for one more request


class RemoteViewer(Part):
    """Listens for a viewer and serves it, or serves the viewer of a caller that listens already.

    Training waits only while the viewer says so. Otherwise it answers a request when one is there, at most one in an
    iteration. Requests of the last iteration are answered after everything is written, and keep_alive holds the process
    there.
    """

    _asked = False

    @staticmethod
    def suits(run: Any) -> bool:
        """Tell whether a viewer may be served. No process of several can draw a view by itself."""
        return not (run.group.several or (run.launch.disable_viewer and network_gui.listener is None))

    def __init__(self, run: Any) -> None:
        """Listen at --ip and --port, unless --disable_viewer is given."""
        self._run, self._gui = run, network_gui
        if not run.launch.disable_viewer:
            ip, port = FEATURES["remote_viewer"].launch[:2]
            address = run.launch.ip, run.launch.port
            run.resources.enter_context(self._gui.listening(*address, address != (ip.default, port.default)))

    def due(self, at: Iteration) -> bool:
        if self._gui.conn is None:
            self._gui.try_connect()
        self._asked = self._gui.has_request() and not at.last
        return self._asked

    def measured(self, at: Iteration, losses: Losses) -> None:
        if self._asked:
            with self._run.clock.paused("viewing"):
                self._serve(last=False)

    def ended(self, error: Error) -> None:
        """Serve the viewer of a finished training until it leaves or lets go, and disconnect it."""
        if error is None:
            if self._gui.conn is None:
                self._gui.try_connect()
            if self._gui.wants_wait(last=True):
                print("The model is saved; this process runs until the viewer disconnects, or until Ctrl-C")
            self._serve(last=True)
        self._gui.disconnect()

    def _serve(self, last: bool) -> None:
        """Answer requests until the viewer lets training go on, the viewer leaves, or a signal asks to stop."""
        while self._has_request(last) and self._answer():
            if not self._gui.wants_wait(last):
                return

    def _has_request(self, last: bool) -> bool:
        """Tell whether a request is there, after waiting for one if the viewer wants that."""
        while self._gui.wants_wait(last) and not self._run.interrupt.requested:
            if self._gui.has_request(_TICK):
                return True
        return self._gui.has_request(_LAST if last else 0.0) and not self._run.interrupt.requested

    def _answer(self) -> bool:
        """Answer one request. Return whether the viewer is still there."""
        try:
            request = self._gui.receive_request()
            frame = None if request is None else self._render_frame(request)
            self._gui.send(frame, self._run.dataset.source_path)
        except ViewerLost:
            return False
        return True

    def _render_frame(self, request: Request) -> memoryview:
        """Return the bytes of a requested frame. If it cannot be rendered, disconnect, and raise ViewerLost."""
        run = self._run
        try:
            return frame_bytes(request, run.gaussians, run.pipe, run.background)
        except Exception as error:  # such as a frame that memory does not suffice for: no reason to end a training
            fault = f"its frame cannot be rendered ({first_line(error)})"
            self._gui.disconnect(fault)
            raise ViewerLost(fault) from error


def frame_bytes(request: Request, gaussians: GaussianModel, pipe: argparse.Namespace, background: Tensor) -> memoryview:
    """Return the RGB bytes (H, W, 3) of the model as `render` shows it: 255 times the colour, truncated.

    pipe: options of the training, which stay as they are. For this frame, the two switches of the request count
        instead.
    """
    switches = {"convert_SHs_python": request.shs_python, "compute_cov3D_python": request.rot_scale_python}
    camera, pipe = request.camera(background.device), argparse.Namespace(**vars(pipe) | switches)
    options = {"want_depth": False, "want_visibility": False}
    with torch.no_grad():
        image = render(camera, gaussians, pipe, background, request.scaling_modifier, **options)["render"]
    return memoryview((image * 255).byte().permute(1, 2, 0).contiguous().cpu().numpy())
