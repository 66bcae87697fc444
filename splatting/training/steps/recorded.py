"""A step that is recorded as a CUDA graph and then taken by one launch.

A step has some fifty launches, which cost the host more than the GPU computes for, and the GPU a gap each. Most steps
differ only in numbers: the camera, the photo, Adam's constants, the iteration. A recorded step reads these from fixed
places in the GPU's memory, which the host fills by a copy. All else is the code of training/steps/fused.py, and the
kernels are the same, so the bytes are those of any other way to take the step.

A record is good for one kind of step (size and angle of the picture, SH degree, statistics or not) until the Gaussians'
tensors are replaced, as density control does, or their lists outgrow its room.
"""

from collections.abc import Callable, Hashable
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gaussian_renderer.view_step import step
from scene.cameras import Camera
from scene.fused_adam import NOW_WORDS, FusedAdam
from splatting.training.objective import Losses
from splatting.training.run import Run
from splatting.training.step import Step
from splatting.training.steps.cuda_graph import Recorder
from splatting.training.steps.fused import FusedStep

_SLOTS = 16  # rows of page-locked memory; more than steps are ever pending
_MOST_KINDS = 4  # photos of more sizes or angles would cost more to record than they save
_CAMERA = 16 + 16 + 3  # numbers: two matrices and the centre

Kind = tuple[Hashable, ...]


@dataclass
class _StillCamera:
    """Stands for any camera of a kind: its matrices and its photo lie in fixed places."""

    image_height: int
    image_width: int
    FoVx: float
    FoVy: float
    world_view_transform: Tensor
    full_proj_transform: Tensor
    camera_center: Tensor
    target: Tensor
    columns: None = None  # all count

    def ground_truth(self, _: Tensor) -> tuple[Tensor, None]:
        """The photo on the step's background, and no mask."""
        return self.target, None


@dataclass
class _StillStep:
    """Stands for any step of a kind. An objective that asks for more than this cannot be recorded."""

    camera: _StillCamera
    background: Tensor
    depth_weight: float = 0.0


@dataclass
class _Record:
    launch: Callable[[], None]
    target: Tensor  # the photo's place
    losses: Tensor  # (2,): total and L1 of the last step


class RecordedStep:
    """Takes steps by one launch, where it can. room: gives operators room for any view (`RunAhead.room`)."""

    def __init__(self, run: Run, fused: FusedStep, room: Callable[[None], AbstractContextManager]) -> None:
        self._run, self._fused, self._room = run, fused, room
        self._adam = FusedAdam(run.gaussians, run.density.penalty)
        self._recorder = Recorder(run.device)
        words = NOW_WORDS + (_CAMERA + 1) // 2
        self._host = torch.zeros(_SLOTS, words, dtype=torch.int64, pin_memory=run.device.type == "cuda")
        self._host_cameras = [row.numpy() for row in self._host[:, NOW_WORDS:].view(torch.float32)[:, :_CAMERA]]
        self._inputs = torch.zeros(words, dtype=torch.int64, device=run.device)
        self._background, self._copied = torch.empty_like(run.background), None
        self._cameras: dict[int, tuple] = {}  # by uid
        self._kinds: set[Kind] = set()
        self._records: dict[Kind, _Record] = {}
        self._baked: tuple = ()
        self._able = True  # whether the objective can be recorded, and memory is there
        self._taken = 0

    def take(self, at: Step) -> Losses | None:
        """Take a step of the run, or do nothing and return None where it has to be taken in another way."""
        record = self._record(at) if self._is_usual(at) else None
        if record is None:
            return None
        target, _ = at.camera.ground_truth(at.background)
        if (target.shape, target.dtype) != (record.target.shape, record.target.dtype):
            return None
        # Nothing below asks for memory or may fail in another way once the optimiser's counters are advanced.
        numbers, losses = self._numbers_of(at.camera), torch.empty_like(record.losses)  # observers keep them
        record.target.copy_(target, non_blocking=True)
        if at.background is not self._copied:
            self._copied = at.background
            self._background.copy_(at.background, non_blocking=True)
        slot = self._taken % _SLOTS
        self._taken += 1
        self._host_cameras[slot][:] = numbers
        self._adam.write_now(self._host[slot, :NOW_WORDS], at.iteration)
        self._inputs.copy_(self._host[slot], non_blocking=True)
        record.launch()
        total, l1 = losses.copy_(record.losses).unbind()
        return Losses(total, l1, None, None)

    def drop(self) -> None:
        """Forget the records: their room was too small."""
        self._records.clear()

    def check(self) -> None:
        """Forget the records if something that they took for fixed has changed."""
        run, optimizer = self._run, self._run.gaussians.optimizer
        columns = optimizer.active_columns("f_rest")
        used = run.objective, run.density, run.pipe.antialiasing, type(optimizer), optimizer.guard, columns
        used = *used, run.resolution.factor
        baked = self._adam.places(), used
        if baked != self._baked:
            self._records.clear()
            self._baked = baked

    def make_room(self) -> None:
        """Give memory back, if most of it is taken, before something else asks for it."""
        if self._records and self._recorder.is_tight():
            self._release()

    def _release(self) -> None:
        self._records.clear()
        self._recorder.release()

    def _is_usual(self, at: Step) -> bool:
        """Whether the step has a photo whose pixels all count, and nothing else."""
        plain = at.depth_weight == 0 and not self._run.dataset.train_test_exp
        return self._able and plain and at.camera.columns is None and at.camera.counts_all

    def _record(self, at: Step) -> _Record | None:
        """The record for a step, made if it is worth it. The first step of a kind is not, as it may load kernels."""
        camera, run = at.camera, self._run
        phase = run.density.observes(at.iteration), run.gaussians.active_sh_degree
        kind = (camera.image_height, camera.image_width, camera.FoVx, camera.FoVy, *phase)
        record = self._records.get(kind)
        if record is not None:
            return record
        if kind not in self._kinds:
            self._kinds.add(kind)
            return None
        self._records = {k: known for k, known in self._records.items() if k[-2:] == phase}
        if len(self._records) < _MOST_KINDS:
            record = self._recorded(at)
            if record is not None:
                self._records[kind] = record
        return record

    def _recorded(self, at: Step) -> _Record | None:
        """Record a step. None, for good, where memory or the objective does not allow it."""
        try:
            try:
                return self._record_once(at)
            except torch.OutOfMemoryError:
                # While it records, torch cannot give back what it keeps for later, which may be enough.
                self._release()
                return self._record_once(at)
        except (RuntimeError, AttributeError):
            self._able = False
            self._release()
            return None

    def _record_once(self, at: Step) -> _Record | None:
        camera, target = at.camera, at.camera.ground_truth(at.background)[0]
        numbers = self._inputs[NOW_WORDS:].view(torch.float32)
        matrices = numbers[:16].view(4, 4), numbers[16:32].view(4, 4), numbers[32:35]
        view = camera.image_height, camera.image_width, camera.FoVx, camera.FoVy
        still = _StillStep(_StillCamera(*view, *matrices, torch.empty_like(target)), self._background)
        with self._room(None):
            launch, losses = self._recorder.record(lambda: self._body(at.iteration, still))
        if self._fused.finds_further_terms():
            self._able = False
            return None
        return _Record(launch, still.camera.target, losses)

    @torch.no_grad()
    def _body(self, iteration: int, still: _StillStep) -> Tensor:
        run = self._run
        drawn, losses, gradients = self._fused.measure(still)
        run.gaussians.guard_loss(iteration, losses.total)
        density = run.density
        observed = density.observes(iteration), density.absolute_gradients
        step(drawn, self._adam, *gradients, *observed, self._inputs[:NOW_WORDS])
        return torch.stack([losses.total, losses.l1])

    def _numbers_of(self, camera: Camera) -> np.ndarray:
        """The camera's numbers (35,) on the host, read from the GPU once."""
        tensors = camera.world_view_transform, camera.full_proj_transform, camera.camera_center
        state = [(id(tensor), tensor._version) for tensor in tensors]
        kept = self._cameras.get(camera.uid)
        if kept is None or kept[0] != state:
            numbers = torch.cat([tensor.detach().reshape(-1).float() for tensor in tensors]).cpu().numpy()
            kept = self._cameras[camera.uid] = state, numbers, tensors  # which are kept, as an id may be given again
        return kept[1]
