"""A step that is recorded as a CUDA graph and then taken by one launch.

A step has some fifty launches, which cost the host more than the GPU computes for, and the GPU a gap each. Most steps
differ only in numbers: the camera, the photo, Adam's constants, the iteration. A recorded step reads these from fixed
places in the GPU's memory, which the host fills by a copy. All else is the code of training/steps/fused.py, and the
kernels are the same, so the bytes are those of any other way to take the step.

A record is good for one kind of step (size and angle of the picture, SH degree, statistics or not) until the Gaussians'
tensors are replaced, as density control does, or their lists outgrow its room.
"""

from collections.abc import Callable, Hashable
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gaussian_renderer.view_step import draw, step
from scene.cameras import Camera
from scene.fused_adam import NOW_WORDS, FusedAdam
from training.objective import Losses, Objective
from training.run import Run
from training.step import Step
from utils.loss_utils import photometric_gradient

_SLOTS = 16  # rows of page-locked memory; more than steps are ever pending
_MOST_KINDS = 4  # photos of all sizes or angles would cost more to record than they save
_CAMERA = 16 + 16 + 3  # numbers: two matrices and the centre
_OWN_LOSS = Objective.__call__

Kind = tuple[Hashable, ...]


@dataclass
class _Still:
    """Stands for any camera of a kind: its matrices and its photo lie in fixed places."""

    image_height: int
    image_width: int
    FoVx: float
    FoVy: float
    world_view_transform: Tensor
    full_proj_transform: Tensor
    camera_center: Tensor


@dataclass
class _Record:
    graph: torch.cuda.CUDAGraph
    target: Tensor  # the photo's place
    losses: Tensor  # (2,): total and L1 of the last step


class RecordedStep:
    """Takes steps by one launch, where it can. room: gives operators room for any view (`RunAhead.room`)."""

    def __init__(self, run: Run, room: Callable[[None], AbstractContextManager]) -> None:
        self._run, self._room = run, room
        self._adam = FusedAdam(run.gaussians)
        words = NOW_WORDS + (_CAMERA + 1) // 2
        self._host = torch.zeros(_SLOTS, words, dtype=torch.int64, pin_memory=True)
        self._host_cameras = [row.numpy() for row in self._host[:, NOW_WORDS:].view(torch.float32)[:, :_CAMERA]]
        self._inputs = torch.zeros(words, dtype=torch.int64, device=run.device)
        self._background = torch.empty_like(run.background)
        self._cameras: dict[Camera, tuple] = {}
        self._kinds: set[Kind] = set()
        self._records: dict[Kind, _Record] = {}
        self._tensors: tuple[int, ...] = ()
        self._stream, self._memory = torch.cuda.Stream(run.device), torch.cuda.graph_pool_handle()
        # Torch gives a pool's memory back once no graph uses it; the next record would wait for it to be allocated.
        self._keeps_memory = self._graph_of(self._background.zero_)[0]
        self._fits = True  # whether there is memory for records
        self._taken = 0

    def take(self, at: Step) -> Losses | None:
        """Take a step of the run, or do nothing and return None where it has to be taken in another way."""
        target = self._target(at)
        record = None if target is None else self._record(at, target)
        if record is None:
            return None
        self._fill(at)
        record.target.copy_(target, non_blocking=True)
        if at.background is not self._run.background:
            self._background.copy_(at.background, non_blocking=True)
        record.graph.replay()
        total, l1 = record.losses.clone().unbind()  # observers keep them
        return Losses(total, l1, None, None)

    def drop(self) -> None:
        """Forget the records: their room was too small."""
        self._records.clear()

    def check(self) -> None:
        """Forget the records if tensors of the Gaussians were replaced."""
        tensors = self._adam.places()
        if tensors != self._tensors:
            self._records.clear()
            self._tensors = tensors

    def _target(self, at: Step) -> Tensor | None:
        """The photo, if the step has the usual loss and nothing else."""
        plain = at.depth_weight == 0 and not self._run.dataset.train_test_exp and at.camera.columns is None
        if not plain or Objective.__call__ is not _OWN_LOSS:
            return None
        target, mask = at.camera.ground_truth(at.background)
        return target if mask is None else None

    def _kind(self, at: Step, target: Tensor) -> Kind:
        camera, run = at.camera, self._run
        view = camera.image_height, camera.image_width, camera.FoVx, camera.FoVy
        random = at.background is not run.background
        return (*view, target.dtype, run.density.observes(at.iteration), run.gaussians.active_sh_degree, random)

    def _record(self, at: Step, target: Tensor) -> _Record | None:
        """The record for a step, made if it is worth it. The first step of a kind is not, as it may load kernels."""
        kind = self._kind(at, target)
        record = self._records.get(kind)
        if record is not None or kind not in self._kinds or len(self._records) == _MOST_KINDS or not self._fits:
            self._kinds.add(kind)
            return record
        try:
            record = self._recorded(at, target)
        except torch.OutOfMemoryError:
            # While it records, torch cannot give back memory that it keeps for later, which may be enough.
            torch.cuda.empty_cache()
            record = self._recorded_if_it_fits(at, target)
        if record is not None:
            self._records[kind] = record
        return record

    def _recorded_if_it_fits(self, at: Step, target: Tensor) -> _Record | None:
        try:
            return self._recorded(at, target)
        except torch.OutOfMemoryError:
            self._fits = False
            self._records.clear()
            self._keeps_memory.reset()
            torch.cuda.empty_cache()
            return None

    def _fill(self, at: Step) -> None:
        """Send the camera and Adam's numbers to the GPU, and advance the optimiser's counters."""
        slot = self._taken % _SLOTS
        self._taken += 1
        self._adam.write_now(self._host[slot, :NOW_WORDS], at.iteration)
        self._host_cameras[slot][:] = self._camera(at.camera)
        self._inputs.copy_(self._host[slot], non_blocking=True)

    def _camera(self, camera: Camera) -> np.ndarray:
        """The camera's numbers (35,) on the host, read from the GPU once."""
        tensors = camera.world_view_transform, camera.full_proj_transform, camera.camera_center
        state = [(id(tensor), tensor._version) for tensor in tensors]
        kept = self._cameras.get(camera)
        if kept is None or kept[0] != state:
            numbers = torch.cat([tensor.detach().reshape(-1).float() for tensor in tensors]).cpu().numpy()
            kept = self._cameras[camera] = state, numbers, tensors  # which are kept, as an id may be given again
        return kept[1]

    def _recorded(self, at: Step, target: Tensor) -> _Record:
        place = torch.empty_like(target)
        with torch.no_grad(), self._room(None):
            graph, losses = self._graph_of(lambda: self._body(at, place))
        return _Record(graph, place, losses)

    def _graph_of(self, body: Callable[[], Tensor]) -> tuple[torch.cuda.CUDAGraph, Tensor]:
        """Record what a function queues; its result lies in the graph's memory."""
        graph = torch.cuda.CUDAGraph()
        self._stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._stream):
            graph.capture_begin(pool=self._memory, capture_error_mode="thread_local")
            try:
                result = body()
            except BaseException:
                with suppress(RuntimeError):  # which tells of the record, not of its cause
                    graph.capture_end()
                raise
            graph.capture_end()
        return graph, result

    def _body(self, at: Step, target: Tensor) -> Tensor:
        run, camera = self._run, at.camera
        numbers = self._inputs[NOW_WORDS:].view(torch.float32)
        matrices = numbers[:16].view(4, 4), numbers[16:32].view(4, 4), numbers[32:35]
        still = _Still(camera.image_height, camera.image_width, camera.FoVx, camera.FoVy, *matrices)
        background = run.background if at.background is run.background else self._background
        drawn = draw(still, run.gaussians, run.pipe, background, want_depth=False)
        total, l1, gradient = photometric_gradient(drawn.image, target, run.opt.lambda_dssim)
        run.gaussians.guard_loss(at.iteration, total)
        step(drawn, self._adam, gradient, None, run.density.observes(at.iteration), self._inputs[:NOW_WORDS])
        return torch.stack([total, l1])
