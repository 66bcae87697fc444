"""The captured step: a fused step that is one launch, taken by a host that runs ahead of its GPU.

A step has some fifty launches, which cost the host more than the GPU computes for, and the GPU a gap each. Most steps
differ only in numbers: the camera, the photo, Adam's constants, the iteration. A captured step reads these from fixed
places in the GPU's memory, which the host fills by a copy. All else is the code of training/steps/fused.py, and the
kernels are the same, so the bytes are those of any other way to take the step.

A graph is good for one kind of step (size and angle of the image, SH degree, statistics or not) until the Gaussians'
tensors are replaced, as density control does, or their lists outgrow its capacity (training/steps/speculative.py).
"""

import gc
from collections.abc import Callable, Hashable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_renderer import photo_name
from scene.cameras import Camera
from scene.fused_adam import CAMERA_NUMBERS, NOW_WORDS, FusedAdam
from splatting.training.announcer import Announcer
from splatting.training.iteration import Iteration, Losses
from splatting.training.run import Run
from splatting.training.steps.fused import FusedStep
from splatting.training.steps.plain import PlainStep
from splatting.training.steps.speculative import AHEAD, Speculation

_ROWS = 16  # of page-locked memory for numbers of steps; more than are ever pending
_MOST_KINDS = 4  # photos of more sizes or angles would cost more to capture than they save
_CAMERA = 16 + 16 + 3  # numbers: two matrices and the centre

Kind = tuple[Hashable, ...]


class CapturedStep(FusedStep):
    """Takes steps as `FusedStep` does, but does not wait for the GPU unless something reads or changes the model.

    An error leaves the model as it was after the last step that was done.
    """

    def __init__(self, run: Run) -> None:
        super().__init__(run)
        self._ahead = Speculation(run.device, self)
        self._graphs = Graphs(run, self, self._adam, self._ahead.capacity)
        pinned = run.device.type == "cuda"
        self._rows = torch.zeros(_ROWS, CAMERA_NUMBERS, dtype=torch.float64, pin_memory=pinned) if run.on_host else None
        self._fetched: dict[int, _Fetched] = {}  # by iteration: of cameras that have yet to step

    def take(self, at: Iteration, observers: Announcer) -> None:
        """Queue a step, unless something is due in it."""
        run = self._run
        if not self._is_queued(at):
            self.drain()  # nothing is pending, unless --debug_from has just come into force
            run.set_rates(at)
            return super().take(at, observers)
        losses = self._queue(at)
        if losses is None:
            self._ahead.discard()
            self._step_on_host(0)
            run.set_rates(at)
            return PlainStep.take(self, at, observers)
        self._ahead.add(at, losses)
        return observers.measured(at, losses)

    def throttle(self, at: Iteration) -> None:
        if self._is_queued(at):
            self._ahead.throttle()
            if host := self._run.on_host:
                most = host.independent(at.camera.uid, [one.uid for one in self._fetched.values()])
                self._ahead.wait(most)
                self._step_on_host(min(most, AHEAD))
        else:
            self.drain()
            self._graphs.save_memory()

    def drain(self) -> None:
        self._ahead.drain()
        self._step_on_host(0)
        if self._run.on_host:
            self._run.on_host.place()

    def abort(self) -> int:
        lost = self._ahead.abort()
        self._step_on_host(sum(not one.done for one in self._fetched.values()))
        self._fetched.clear()
        if self._run.on_host:
            self._run.on_host.place()
        return lost

    def _is_queued(self, at: Iteration) -> bool:
        return not (at.due or at.last) and self._fuses(at)

    def _knows_model(self) -> bool:
        knows = super()._knows_model()
        if knows:
            self._graphs.check()
        return knows

    def _queue(self, at: Iteration) -> Losses | None:
        """Queue a step. Returns its losses, or None if these have further terms."""
        run, density = self._run, self._run.density
        losses = self._graphs.launch(at)
        if losses is not None:
            self._fetch(at)
            flushes = run.sleeping is not None and run.sleeping.flushes(at.iteration)
            queues = density.queues or run.gaussians.exposures.applied or flushes
            with self._ahead.capacity(at) if queues else nullcontext():
                run.gaussians.exposures.step()
                run.after_step(at)
            return losses
        with self._ahead.capacity(at):
            drawn, losses, gradients = self.measure(at)
            if self.drop_further_terms():
                return None
            run.gaussians.guard_loss(at.iteration, losses.total)
            self.advance(at, drawn, gradients)
            self._fetch(at)
            self.follow(at)
        return losses

    def _fetch(self, at: Iteration) -> None:
        """Queue a copy to the host of the gradient of the view's camera."""
        if self._rows is None:
            return
        row = self._rows[at.iteration % _ROWS]
        row.copy_(self.camera_gradient, non_blocking=True)
        copied = torch.cuda.current_stream().record_event() if row.is_pinned() else None
        self._fetched[at.iteration] = _Fetched(at.camera.uid, row, copied)

    def _step_on_host(self, most: int) -> None:
        """Take the steps of cameras that steps of the Gaussians left behind, but at most so many of the last.

        They wait as long as they may: to wait for a step's end here would let the GPU run out of work.
        """
        while len(self._fetched) > most:
            iteration = next(iter(self._fetched))
            fetched = self._fetched.pop(iteration)
            if fetched.copied is not None:
                fetched.copied.synchronize()
            step = self._run.schedule.schedule_step(iteration)
            self._run.on_host.step(fetched.uid, fetched.gradient.numpy(), step)

    # What speculation asks for, of steps that are done or overflowed

    def finished(self, at: Iteration) -> None:
        """Note that the GPU takes that step of the Gaussians for good."""
        if self._rows is not None:
            self._fetched[at.iteration].done = True

    def replay(self, at: Iteration, first: Losses) -> None:
        """Queue a step once more, with the same values, which go into the losses that observers hold (`first`)."""
        self._run.set_rates(at)
        losses = self._queue(at)
        with torch.no_grad():
            # One of them may be of a graph, which tells of no terms.
            terms = losses.terms.keys() & first.terms.keys()
            pairs = [(losses.total, first.total), (losses.l1, first.l1)]
            for new, old in pairs + [(losses.terms[name], first.terms[name]) for name in terms]:
                old.detach().copy_(new)

    def rewind(self, steps: int) -> None:
        """Take back what the host has counted for steps that will be replayed, or that an error has ended."""
        self._run.gaussians.rewind(steps)
        if steps and self._run.sleeping:
            self._run.sleeping.stepped()  # a rest may be among the steps
        self._graphs.clear()


@dataclass
class _Fetched:
    uid: int
    gradient: Tensor  # (CAMERA_NUMBERS,) on the host, once it is copied
    copied: torch.cuda.Event | None
    done: bool = False


@dataclass
class _Graph:
    launch: Callable[[], None]
    target: Tensor  # the photo's place
    losses: Tensor  # (2,): total and L1 of the last step


class Graphs:
    """Takes fused steps by one launch, where it can. capacity: that of any view (`Speculation.capacity`)."""

    def __init__(
        self, run: Run, fused: FusedStep, adam: FusedAdam, capacity: Callable[[None], AbstractContextManager]
    ) -> None:
        self._run, self._fused, self._adam, self._capacity = run, fused, adam, capacity
        self._recorder = Recorder(run.device)
        words = NOW_WORDS + (_CAMERA + 1) // 2 + 1  # the last one: the index of the photo
        self._host = torch.zeros(_ROWS, words, dtype=torch.int64, pin_memory=run.device.type == "cuda")
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
        """Take a step of the run, or do nothing and return None where it has to be taken in another way."""
        graph = self._graph_for(at) if self._is_usual(at) else None
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
        row = self._taken % _ROWS
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
        """Forget the graphs: their capacity was too small."""
        self._graphs.clear()

    def check(self) -> None:
        """Forget the graphs if something that they took for fixed has changed."""
        run, optimizer = self._run, self._run.gaussians.optimizer
        columns = optimizer.active_columns("f_rest")
        used = run.objective, run.density, run.pipe.antialiasing, type(optimizer), optimizer.guard, columns
        used = *used, run.sizes.factor, run.sleeping and run.sleeping.awake.data_ptr()
        baked = self._adam.places(), used
        if baked != self._baked:
            self._graphs.clear()
            self._baked = baked

    def save_memory(self) -> None:
        """Give memory back, if most of it is taken, before something else asks for it."""
        if self._graphs and self._recorder.is_tight():
            self._release()

    def _release(self) -> None:
        self._graphs.clear()
        self._recorder.release()

    def _is_usual(self, at: Iteration) -> bool:
        """Whether the photo has no mask, and what parts add to the loss can be captured."""
        return self._able and at.captured and at.camera.counts_all_pixels

    def _graph_for(self, at: Iteration) -> _Graph | None:
        """The graph for a step, made if it is worth it. The first step of a kind is not, as it may load kernels."""
        camera, run = at.camera, self._run
        held = run.gaussians.exposures.applied and run.gaussians.exposures.held
        phase = run.density.observes(at.iteration), run.gaussians.active_sh_degree, held
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
            graph = self._captured(at)
            if graph is not None:
                self._graphs[kind] = graph
        return graph

    def _captured(self, at: Iteration) -> _Graph | None:
        """Capture a step. None, for good, where memory or the objective does not allow it."""
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
            terms={},
            captured=True,
            wants_depth=False,
            changes=False,
            last=False,
        )
        self._run.add_terms(placeholder)
        with self._capacity(None):
            launch, losses = self._recorder.capture(lambda: self._body(at.iteration, placeholder))
        if self._fused.drop_further_terms():
            self._able = False
            return None
        return _Graph(launch, target, losses)

    @torch.no_grad()
    def _body(self, iteration: int, placeholder: Any) -> Tensor:
        run = self._run
        now = self._inputs[:NOW_WORDS]
        if run.gaussians.exposures.applied:
            run.gaussians.exposures.keep_gradients()
            run.gaussians.exposures.optimizer.zero_grad(set_to_none=False)
        drawn, losses, gradients = self._fused.measure(placeholder, now)
        run.gaussians.guard_loss(iteration, losses.total)
        density = run.density
        observed = density.observes(iteration), density.absolute_gradients
        drawn.step(self._adam, *gradients, *observed, now, self._fused.camera_gradient)
        return torch.stack([losses.total, losses.l1])

    def _numbers_of(self, camera: Camera) -> np.ndarray:
        """The camera's numbers (35,) on the host, read from the GPU once; those of a trained pose never lie there."""
        if host := self._run.on_host:
            host.place(camera)
            return camera.numbers[:_CAMERA]
        tensors = camera.world_view_transform, camera.full_proj_transform, camera.camera_center
        state = [(id(tensor), tensor._version) for tensor in tensors]
        kept = self._cameras.get(camera.uid)
        if kept is None or kept[0] != state:
            numbers = torch.cat([tensor.detach().reshape(-1).float() for tensor in tensors]).cpu().numpy()
            kept = self._cameras[camera.uid] = state, numbers, tensors  # which are kept, as an id may be given again
        return kept[1]


class Recorder:
    """Captures on a stream of its own, on which nothing ever runs. All graphs share one pool of memory."""

    def __init__(self, device: torch.device) -> None:
        self._device, self._stream = device, torch.cuda.Stream(device)
        self._keeper: torch.cuda.CUDAGraph | None = None

    def capture(self, body: Callable[[], Tensor]) -> tuple[Callable[[], None], Tensor]:
        """Capture what a function queues: a function that queues it, and the result, which each launch overwrites.

        RuntimeError, torch.OutOfMemoryError among them, if it cannot be captured.
        """
        if self._keeper is None:
            self._pool, self._word = torch.cuda.graph_pool_handle(), torch.zeros(1, device=self._device)
            # Torch gives the pool's memory back once no graph uses it; the next capture would wait for it.
            self._keeper, _ = self._graph_of(self._word.zero_)
        graph, result = self._graph_of(body)
        return graph.replay, result

    def release(self) -> None:
        """Give back the memory of graphs that nobody has any more, and what torch keeps for later."""
        self._keeper = None
        torch.cuda.empty_cache()

    def is_tight(self) -> bool:
        """Whether most of what torch may take is taken, so that what is kept for later should be given back."""
        free, total = torch.cuda.mem_get_info(self._device)
        most = torch.cuda.get_per_process_memory_fraction() * total
        return min(free, most - torch.cuda.memory_reserved(self._device)) < most / 4

    def _graph_of(self, body: Callable[[], Tensor]) -> tuple[torch.cuda.CUDAGraph, Tensor]:
        self._stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._stream), _no_collection():
            # capture_begin allocates two words for the random generator. Where that fails, torch's destructor of the
            # graph throws, which aborts the process. Here it fails before there is a graph.
            words = [torch.empty(1, dtype=torch.int64, device=self._device) for _ in range(2)]
            del words  # to the cache of this stream, which the next allocations take
            graph = torch.cuda.CUDAGraph()
            graph.capture_begin(pool=self._pool, capture_error_mode="thread_local")
            try:
                result = body()
                graph.capture_end()
            except BaseException:
                self._end(graph)
                raise
        return graph, result

    def _end(self, graph: torch.cuda.CUDAGraph) -> None:
        """End a capture that has failed, so that torch's allocator and generator take part in it no longer."""
        index = torch.cuda.current_device()
        try:
            graph.capture_end()
        except RuntimeError:  # which tells of the capture, not of its cause, and ends nothing else
            with suppress(RuntimeError):
                # Within a capture, torch gives no memory back to the driver.
                torch._C._cuda_endAllocateToPool(index, self._pool)
                torch._C._cuda_releasePool(index, self._pool)
        # Where the body has ended the capture, torch's generator would go on as in one, and fail.
        generator = torch.cuda.default_generators[index]
        generator.graphsafe_set_state(generator.clone_state())


@contextmanager
def _no_collection() -> Iterator[None]:
    """Within it Python collects no garbage: to destroy the graph of an earlier training would invalidate a capture."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
