"""Graphs of fused steps: most steps differ only in numbers, which a graph reads from fixed places in the GPU's memory.

The numbers are the camera, the photo, Adam's constants and the iteration. The host fills them in by a copy. A graph
serves one kind of step (size and angle of the image, SH degree, with or without statistics). It lasts until the tensors
of the Gaussians are replaced, as density control does, or until the lists of a step outgrow the graph's capacity
(splatting/faster/speculative.py).
"""

from collections.abc import Callable, Hashable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_renderer import photo_name
from scene.cameras import Camera
from scene.fused_adam import NOW_WORDS, FusedAdam
from splatting.faster.fused import FusedStep
from splatting.faster.recorder import Recorder
from splatting.iteration import Iteration, Losses
from splatting.run import Run

ROWS = 16  # of page-locked memory for numbers of steps; more than are ever pending
_MOST_KINDS = 4  # photos of more sizes or angles would cost more to capture than they save
_CAMERA = 16 + 16 + 3  # numbers: two matrices and the centre

Kind = tuple[Hashable, ...]


@dataclass
class _Graph:
    launch: Callable[[], None]
    target: Tensor  # the photo's place
    losses: Tensor  # (2,): total and L1 of the last step


class Graphs:
    """Takes fused steps by one launch, where that is possible.

    capacity: `Speculation.capacity`; the graphs use that of any view.
    """

    def __init__(
        self, run: Run, fused: FusedStep, adam: FusedAdam, capacity: Callable[[None], AbstractContextManager]
    ) -> None:
        """Allocate the fixed places on the GPU from which graphs read the numbers of a step.

        fused: renders and differentiates the view that a graph records.
        adam: optimiser whose step a graph records.
        """
        self._run, self._fused, self._adam, self._capacity = run, fused, adam, capacity
        self._recorder = Recorder(run.device)
        words = NOW_WORDS + (_CAMERA + 1) // 2 + 1  # the last one: the index of the photo
        self._host = torch.zeros(ROWS, words, dtype=torch.int64, pin_memory=run.device.type == "cuda")
        self._host_cameras = [row.numpy() for row in self._host[:, NOW_WORDS:].view(torch.float32)[:, :_CAMERA]]
        self._inputs = torch.zeros(words, dtype=torch.int64, device=run.device)
        self._background, self._copied = torch.empty_like(run.background), None
        self._cameras: dict[int, tuple] = {}  # by uid
        self._kinds: set[Kind] = set()
        self._graphs: dict[Kind, _Graph] = {}
        self._baked: tuple = ()
        self._able = True  # the objective can be captured, and memory is there
        self._taken = 0

    def launch(self, at: Iteration) -> Losses | None:
        """Take a step of the run. Return None, having done nothing, where the step has to be taken in another way."""
        graph = self._find_graph(at) if self._is_usual(at) else None
        if graph is None:
            return None
        target, _ = at.camera.ground_truth(at.background)
        if (target.shape, target.dtype) != (graph.target.shape, graph.target.dtype):
            return None
        # Nothing below asks for memory or may fail in another way once the optimiser's counters are advanced.
        numbers, losses = self._numbers_of(at.camera), torch.empty_like(graph.losses)  # observers keep them
        graph.target.copy_(target, non_blocking=True)
        if at.background is not self._copied:
            self._copied = at.background
            self._background.copy_(at.background, non_blocking=True)
        row = self._taken % ROWS
        self._taken += 1
        self._host_cameras[row][:] = numbers
        self._adam.write_now(self._host[row, :NOW_WORDS], at.iteration)
        exposures = self._run.gaussians.exposures
        if exposures.applied:
            self._host[row, -1] = exposures.mapping[photo_name(at.camera)]
        self._inputs.copy_(self._host[row], non_blocking=True)
        graph.launch()
        total, l1 = losses.copy_(graph.losses).unbind()
        if exposures.applied:
            exposures.keep_gradients()
            self._run.gaussians.guard_loss(at.iteration, total)
        return Losses(total, l1, {}, None)

    def clear(self) -> None:
        """Forget the graphs, whose capacity was too small."""
        self._graphs.clear()

    def check(self) -> None:
        """Forget the graphs if tensors or options have changed whose addresses or values they have recorded."""
        run, optimizer = self._run, self._run.gaussians.optimizer
        columns = optimizer.active_columns("f_rest")
        used = run.objective, run.strategy, run.pipe.antialiasing, type(optimizer), optimizer.guard, columns
        used = *used, run.sizes.factor, run.sleeping and run.sleeping.awake.data_ptr()
        baked = self._adam.places(), used
        if baked != self._baked:
            self._graphs.clear()
            self._baked = baked

    def save_memory(self) -> None:
        """Give memory back, if most of it is taken, before something else asks for memory."""
        if self._graphs and self._recorder.is_tight():
            self._release()

    def _release(self) -> None:
        self._graphs.clear()
        self._recorder.release()

    def _is_usual(self, at: Iteration) -> bool:
        """Tell whether the photo has no mask, and the terms of parts can be captured."""
        return self._able and at.captured and at.camera.counts_all_pixels

    def _find_graph(self, at: Iteration) -> _Graph | None:
        """Return the graph for a step, captured if that is worth it; None without a graph.

        The first step of a kind is not captured, as it may load kernels.
        """
        camera, run = at.camera, self._run
        held = run.gaussians.exposures.applied and run.gaussians.exposures.held
        phase = at.density.observe, run.gaussians.active_sh_degree, held
        size = camera.image_height, camera.image_width, camera.FoVx, camera.FoVy
        kind = (*size, camera.lens, str(camera.columns), *at.terms, *phase)
        graph = self._graphs.get(kind)
        if graph is not None:
            return graph
        if kind not in self._kinds:
            self._kinds.add(kind)
            return None
        self._graphs = {k: known for k, known in self._graphs.items() if k[-3:] == phase}
        if len(self._graphs) < _MOST_KINDS:
            graph = self._try_capture(at)
            if graph is not None:
                self._graphs[kind] = graph
        return graph

    def _try_capture(self, at: Iteration) -> _Graph | None:
        """Capture a step. Return None, for good, where memory or the objective does not allow it."""
        try:
            try:
                return self._capture(at)
            except torch.OutOfMemoryError:
                # While it captures, torch cannot give back what it keeps for later, which may be enough.
                self._release()
                return self._capture(at)
        except (RuntimeError, AttributeError):
            self._able = False
            self._release()
            return None
        finally:
            self._run.gaussians.exposures.optimizer.zero_grad()  # what was recorded has computed no gradient

    def _capture(self, at: Iteration) -> _Graph | None:
        """Capture the step of an iteration's kind. Return None if its loss depends on more than image and exposures.

        A placeholder stands for the iteration: its camera, photo and background are the places that `launch` fills.
        """
        camera, target = at.camera, torch.empty_like(at.camera.ground_truth(at.background)[0])
        numbers = self._inputs[NOW_WORDS:].view(torch.float32)
        # Stand for any iteration of the kind. An objective that asks for more than this cannot be captured.
        any_camera = SimpleNamespace(
            image_height=camera.image_height,
            image_width=camera.image_width,
            FoVx=camera.FoVx,
            FoVy=camera.FoVy,
            lens=camera.lens,
            world_view_transform=numbers[:16].view(4, 4),
            full_proj_transform=numbers[16:32].view(4, 4),
            camera_center=numbers[32:35],
            columns=camera.columns,
            counts_all_pixels=True,
            ground_truth=lambda _: (target, None),  # the photo on the step's background, and no mask
            exposure_name=self._inputs[-1:],
        )
        placeholder = SimpleNamespace(
            camera=any_camera,
            background=self._background,
            density=at.density,
            terms={},
            captured=True,
            wants_depth=False,
            changes=False,
            steps=True,
        )
        self._run.add_terms(placeholder)
        with self._capacity(None):
            launch, losses = self._recorder.capture(lambda: self._compute_step(at.iteration, placeholder))
        if self._fused.drops_parameter_terms():
            self._able = False
            return None
        return _Graph(launch, target, losses)

    @torch.no_grad()
    def _compute_step(self, iteration: int, placeholder: Any) -> Tensor:
        """Compute the step that is captured, on the placeholder. Return its total and L1 losses, (2,)."""
        run = self._run
        now = self._inputs[:NOW_WORDS]
        if run.gaussians.exposures.applied:
            run.gaussians.exposures.keep_gradients()
            run.gaussians.exposures.optimizer.zero_grad(set_to_none=False)
        drawn, losses, gradients = self._fused.measure(placeholder, now)
        run.gaussians.guard_loss(iteration, losses.total)
        observed = placeholder.density.observe, self._fused.absolute_gradients
        drawn.step(self._adam, *gradients, *observed, now, self._fused.camera_gradient)
        return torch.stack([losses.total, losses.l1])

    def _numbers_of(self, camera: Camera) -> np.ndarray:
        """Return the camera's numbers (35,) on the host: read from the GPU once, or those of a trained pose."""
        if host := self._run.camera_steps:
            host.place(camera)
            return camera.numbers[:_CAMERA]
        tensors = camera.world_view_transform, camera.full_proj_transform, camera.camera_center
        state = [(id(tensor), tensor._version) for tensor in tensors]
        kept = self._cameras.get(camera.uid)
        if kept is None or kept[0] != state:
            numbers = torch.cat([tensor.detach().reshape(-1).float() for tensor in tensors]).cpu().numpy()
            kept = self._cameras[camera.uid] = state, numbers, tensors  # which are kept, as an id may be given again
        return kept[1]
