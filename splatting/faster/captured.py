"""The captured step: a fused step that is one launch, taken by a host that runs ahead of its GPU.

A step has some fifty launches. Each costs the host more than the GPU computes for it, and leaves the GPU idle for a
moment. So most steps are replayed as graphs (splatting/faster/graphs.py). All else is the code of
splatting/faster/fused.py, and the kernels are the same, so the bytes are those of any other way to take the step.
"""

from contextlib import nullcontext
from dataclasses import dataclass

import torch
from torch import Tensor

from scene.fused_adam import CAMERA_NUMBERS
from splatting.faster.faster import Tell
from splatting.faster.fused import FusedStep
from splatting.faster.graphs import ROWS, Graphs
from splatting.faster.speculative import AHEAD, Speculation
from splatting.iteration import Iteration, Losses
from splatting.run import Run


class CapturedStep(FusedStep):
    """Takes steps as `FusedStep` does, but does not wait for the GPU unless something reads or changes the model."""

    def __init__(self, run: Run) -> None:
        """Prepare the graphs and, where cameras are trained, page-locked rows for the gradients of cameras."""
        super().__init__(run)
        self._ahead = Speculation(run.device, self)
        self._graphs = Graphs(run, self, self._adam, self._ahead.capacity)
        pinned = run.device.type == "cuda"
        self._rows = (
            torch.zeros(ROWS, CAMERA_NUMBERS, dtype=torch.float64, pin_memory=pinned) if run.camera_steps else None
        )
        self._fetched: dict[int, _Fetched] = {}  # by iteration: of cameras that have yet to step

    def take(self, at: Iteration, tell: Tell) -> bool:
        """Queue a step on the GPU, and do not wait for it. Return False for a step that `plain_step` must take.

        A step is taken as `FusedStep` does, after all pending ones, in an iteration that is due: in it the model is
        read, written or changed (`Iteration.due`).

        tell: receives the losses. The GPU may have yet to compute those of a step that was queued.
        """
        run = self._run
        if not self._is_queued(at):
            self.drain()  # nothing is pending, unless --debug_from has just come into force
            run.set_rates(at)
            return super().take(at, tell)
        losses = self._queue(at)
        if losses is None:
            self._ahead.discard()
            self._step_on_host(0)
            run.set_rates(at)
            return False
        self._ahead.add(at, losses)
        tell.measured(at, losses)
        return True

    def throttle(self, at: Iteration) -> None:
        """Wait until fewer than AHEAD steps are pending; until none is, if this step cannot be queued.

        Where cameras are trained, first take those of their pending steps that change this view's pose.
        """
        if self._is_queued(at):
            self._ahead.throttle()
            if host := self._run.camera_steps:
                most = host.count_independent(at.camera.uid, [one.uid for one in self._fetched.values()])
                self._ahead.wait(most)
                self._step_on_host(min(most, AHEAD))
        else:
            self.drain()
            self._graphs.save_memory()

    def drain(self) -> None:
        self._ahead.drain()
        self._step_on_host(0)
        if self._run.camera_steps:
            self._run.camera_steps.place()

    def abort(self) -> None:
        self._ahead.abort()

    def _is_queued(self, at: Iteration) -> bool:
        """Tell whether the step is queued: there is one, nobody reads or changes the model, and it can be fused."""
        return at.steps and not at.due and self._fuses(at)

    def _knows_model(self) -> bool:
        knows = super()._knows_model()
        if knows:
            self._graphs.check()
        return knows

    def _queue(self, at: Iteration) -> Losses | None:
        """Queue a step. Return its losses, or None if the loss depends on a parameter otherwise than by the image."""
        run, strategy = self._run, self._run.strategy
        losses = self._graphs.launch(at)
        if losses is not None:
            self._fetch(at)
            flushes = run.sleeping is not None and run.sleeping.flushes(at.iteration)
            queues = strategy.queues or run.gaussians.exposures.applied or flushes
            with self._ahead.capacity(at) if queues else nullcontext():
                run.gaussians.exposures.step()
                run.after_step(at)
            return losses
        with self._ahead.capacity(at):
            drawn, losses, gradients = self.measure(at)
            if self.drops_parameter_terms():
                return None
            run.gaussians.guard_loss(at.iteration, losses.total)
            self.advance(at, drawn, gradients)
            self._fetch(at)
            self.follow(at)
        return losses

    def _fetch(self, at: Iteration) -> None:
        """Queue a copy of the gradient of the view's camera to the host."""
        if self._rows is None:
            return
        row = self._rows[at.iteration % ROWS]
        row.copy_(self.camera_gradient, non_blocking=True)
        copied = torch.cuda.current_stream().record_event() if row.is_pinned() else None
        self._fetched[at.iteration] = _Fetched(at.camera.uid, row, copied)

    def _step_on_host(self, most: int) -> None:
        """Take pending steps of cameras, until at most `most` are left.

        Steps of cameras wait as long as they may: to wait here for the end of a step would let the GPU run out of work.
        """
        while len(self._fetched) > most:
            iteration = next(iter(self._fetched))
            fetched = self._fetched.pop(iteration)
            if fetched.copied is not None:
                fetched.copied.synchronize()
            step = self._run.schedule.schedule_step(iteration)
            self._run.camera_steps.step(fetched.uid, fetched.gradient.numpy(), step)

    # What speculation asks for, of steps that are done or overflowed

    def replay(self, at: Iteration, first: Losses) -> None:
        """Queue a step once more, and copy its losses, which are the same, into those that observers hold (`first`)."""
        self._run.set_rates(at)
        losses = self._queue(at)
        with torch.no_grad():
            # One of them may be of a graph, which tells of no terms.
            terms = losses.terms.keys() & first.terms.keys()
            pairs = [(losses.total, first.total), (losses.l1, first.l1)]
            for new, old in pairs + [(losses.terms[name], first.terms[name]) for name in terms]:
                old.detach().copy_(new)

    def rewind(self, steps: int) -> None:
        """Take back the counts of the host for steps that will be replayed."""
        self._run.gaussians.rewind(steps)
        if steps and self._run.sleeping:
            self._run.sleeping.stepped()  # one that woke all blocks (REST of scene/sleeping.py) may be among the steps
        self._graphs.clear()


@dataclass
class _Fetched:
    """The gradient of a camera, on its way to the host, where the camera's step is pending."""

    uid: int  # of the camera
    gradient: Tensor  # (CAMERA_NUMBERS,) on the host, once it is copied
    copied: torch.cuda.Event | None  # the end of the copy; None if it was made at once
