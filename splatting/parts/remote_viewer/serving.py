"""Answers to the remote viewer of the reference while a training goes on, and after it."""

import argparse

import torch
from torch import Tensor

from gaussian_renderer import network_gui, render
from gaussian_renderer.network_message import Request
from gaussian_renderer.network_transfer import ViewerLost
from scene.gaussian_model import GaussianModel
from splatting.part import Error
from splatting.training.iteration import Iteration, Losses
from splatting.training.run import Run
from utils.system_utils import first_line

_TICK = 0.1  # seconds between looks whether a signal asks to stop
_LAST = 1.0  # seconds that a finished training waits for one more request


class Serving:
    """Serves the viewer of gaussian_renderer/network_gui.py.

    Training waits only while the viewer says so. Otherwise a request is answered when it is there, one an iteration.
    The last iteration's are answered after everything is written, and keep_alive holds the process there.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self._asked = False

    def due(self, step: Iteration) -> bool:
        if network_gui.conn is None:
            network_gui.try_connect()
        self._asked = network_gui.is_asked() and not step.last
        return self._asked

    def measured(self, step: Iteration, losses: Losses) -> None:
        if self._asked:
            with self._run.clock.paused("viewing"):
                self._serve(last=False)

    def ended(self, error: Error) -> None:
        if error is None:
            if network_gui.conn is None:
                network_gui.try_connect()
            if network_gui.holds(last=True):
                print("The model is saved; this process runs until the viewer disconnects, or until Ctrl-C")
            self._serve(last=True)
        network_gui.disconnect()

    def _serve(self, last: bool) -> None:
        """Answer until the viewer lets training go on, leaves, or a signal asks to stop."""
        while self._waits(last) and self._answer():
            if not network_gui.holds(last):
                return

    def _waits(self, last: bool) -> bool:
        """Whether a request is there, after waiting for it if the viewer wants that."""
        while network_gui.holds(last) and not self._run.interrupt.requested:
            if network_gui.is_asked(_TICK):
                return True
        return network_gui.is_asked(_LAST if last else 0.0) and not self._run.interrupt.requested

    def _answer(self) -> bool:
        """Answer one request; whether the viewer is still there."""
        try:
            request = network_gui.receive_request()
            frame = None if request is None else self._frame(request)
            network_gui.send(frame, self._run.dataset.source_path)
        except ViewerLost:
            return False
        return True

    def _frame(self, request: Request) -> memoryview:
        run = self._run
        try:
            return frame_bytes(request, run.gaussians, run.pipe, run.background)
        except Exception as error:  # such as a frame that memory does not suffice for: no reason to end a training
            fault = f"its frame cannot be rendered ({first_line(error)})"
            network_gui.disconnect(fault)
            raise ViewerLost(fault) from error


@torch.no_grad()
def frame_bytes(request: Request, gaussians: GaussianModel, pipe: argparse.Namespace, background: Tensor) -> memoryview:
    """RGB bytes (H, W, 3) of the model as `render` shows it: 255 times the colour, truncated.

    pipe: options of the training, which stay as they are; for the frame, the request's two switches count instead.
    """
    switches = {"convert_SHs_python": request.shs_python, "compute_cov3D_python": request.rot_scale_python}
    image = render(
        request.camera(background.device),
        gaussians,
        argparse.Namespace(**vars(pipe) | switches),
        background,
        request.scaling_modifier,
        want_depth=False,
        want_visibility=False,
    )["render"]
    return memoryview((image * 255).byte().permute(1, 2, 0).contiguous().cpu().numpy())
