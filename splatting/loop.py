"""The training loop: an iteration from top to bottom, and the observers that run beside it.

A part is a class whose hooks add one feature to a training (splatting/part.py). An observer is a part that
only watches.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from types import TracebackType

import torch
from torch import Tensor

from gaussian_renderer import apply_trained_exposure, draw, render, to_world_units, wake
from gaussian_renderer.memory_errors import explain_memory_errors
from groundwork.applications import application
from splatting.agreement import StepAgreement
from splatting.curve import Curve
from splatting.events import LossEvents
from splatting.faster import FasterSteps, faster_steps
from splatting.iteration import Iteration, Losses
from splatting.log import ProgressBar, Records, Summary
from splatting.part import Error, Part
from splatting.remote_viewer import RemoteViewer
from splatting.resume import Resume
from splatting.run import Run, overrides
from splatting.save import Saves
from splatting.scores import Scores, training_report
from splatting.watch import MaskWatch

_REMEDY = "lower --resolution (-r), --max_num_splats or --images_to_load, and resume from the last checkpoint"


def plain_step(run: Run, at: Iteration, tell: "Announcer") -> None:
    """Take the step of an iteration as the paper describes it (Kerbl et al. 2023, Sections 4 to 6), by autograd.

    Objectives, strategies and hooks of other programs find every gradient of every parameter.
    """
    gaussians, strategy, options = run.gaussians, run.strategy, run.render_options(at)
    _prepare_rows(run, at)  # all of them, unless blocks of rows sleep (scene/sleeping.py)
    package = render(at.camera, gaussians, run.pipe, at.background, **options)
    planes = _keep_planes(package, run)
    if gaussians.exposures.applied:
        package["render"] = apply_trained_exposure(package["render"], at.camera, gaussians)
    losses = run.objective(package, at)  # (1 - lambda) L1 + lambda (1 - SSIM), and terms of parts
    losses.total.backward()
    if _reaches_sleepers(run):
        _stop_skipping(run)
        return plain_step(run, at, tell)
    if planes and at.steps:
        _step_camera(run, at, planes)  # a view's pose and lens, where they are trained
    if any(strategy.penalty):
        gaussians.add_penalty_gradients(strategy.penalty)  # a part of the loss that no render shows
    tell.measured(at, losses)  # progress, scores and saves of the model as it was rendered
    strategy.after_backward(at, package)  # statistics; clone, split, prune, reset opacities
    if at.steps:  # as in the reference, the last iteration takes no step
        gaussians.step(package["radii"])  # Adam
        run.after_step(at)


def run_training(run: Run, observers: Sequence[Part]) -> None:
    """Take the iterations of a run.

    All else that happens in an iteration is the work of observers, in the order of the list (`standard_observers`).
    Raises KeyboardInterrupt or Terminated, after a complete step, if a signal asks for it.
    """
    for _ in training_steps(run, observers):
        pass


def training_steps(run: Run, observers: Sequence[Part]) -> Iterator[tuple[Iteration, FasterSteps]]:
    """Take the iterations of a run as `run_training` does, and yield each one with its `FasterSteps`.

    `FasterSteps` take steps faster than `plain_step`, with the same bytes. A caller may read the model once it has
    drained them, within `run.flushed_view()`.
    """
    faster = faster_steps(run)
    barrier = StepAgreement(run.group, run.interrupt, getattr(run.gaussians.optimizer, "guard", None))
    tell = Announcer([barrier, *observers], run.flushed_view)
    at = None
    try:
        # Backward runs on this thread: waking autograd's worker costs time in every iteration.
        explained = explain_memory_errors(run.gaussians, run.views.cameras, _REMEDY, "training")
        with explained, run.interrupt, tell, torch.autograd.set_multithreading_enabled(False):
            try:
                for at in run.iterations():  # a view in the order of the seed, its background, terms of the loss
                    tell.begins(at)  # who reads or writes the model in it?
                    barrier.begins(at)
                    faster.throttle(at)  # before the learning rates are set, which a replayed step changes
                    run.prepare(at)  # learning rates, SH degree, photos of the next views
                    if not faster.take(at, tell):
                        plain_step(run, at, tell)
                    at.stopping = barrier.stopping  # read once: a signal may come at any moment
                    if at.stopping:
                        faster.drain()
                    if at.rests:
                        run.gaussians.drop_gradients()  # the earlier run, which ended here, left none to the next one
                    tell.stepped(at)  # checkpoints, viewers
                    if at.stopping:
                        raise at.stopping
                    yield at, faster
            except BaseException:
                faster.abort()
                raise
    except KeyboardInterrupt:
        if at is not None and at.stopping:
            barrier.wait()
        raise
    tell.ended()  # out here a signal stops at once what is only drawn and printed


def standard_observers(run: Run) -> list[Part]:
    """Return the observers of every training, and among them, in their place, the parts of the run."""
    last = _last_observers(run)  # made before the progress bar, as they print when they are made
    if run.report is not training_report:
        run.stop_skipping()  # it may read or change the model in every iteration
    return [
        run.watch,  # first: observers that write rely on all losses so far being finite
        *([ProgressBar(run)] if run.group.first else []),  # reads the losses that the watch has checked
        MaskWatch(run.scene.getTrainCameras()),  # may refuse the scene before anything is written
        *([] if run.launch.no_curve or not run.scene.getTestCameras() else [Curve(run)]),  # scores what is saved now
        *run.parts,
        *([LossEvents(run)] if run.writer is not None and run.report is training_report else []),
        Scores(run),
        Saves(run),  # before the model changes
        Records(run),  # after all that add to the iteration's record
        Summary(run),  # after all that say something at the end
        run.checkpoints,  # writes the whole state after the step
        *last,
    ]


def _last_observers(run: Run) -> list[Part]:
    """Return the observers that come last: checkpoints of --resume, then the viewers.

    Viewers may pause the training, so all other work of an iteration is done and written before.
    """
    last: list[Part] = [Resume(run)]
    if RemoteViewer.suits(run):
        last.append(RemoteViewer(run))
    if run.launch.viewer is not None:
        page = application("viewer", "training_page").TrainingPage(run)
        run.resources.callback(page.close)
        last.append(page)  # at the end, so that a pause comes after all other work
    return last


class Announcer:
    """Calls the hooks of parts, in the order of the list. As a context manager, it passes an error on to `ended`."""

    def __init__(self, parts: Sequence[Part], flushed: Callable[[], AbstractContextManager] = nullcontext) -> None:
        """Collect the hooks that the parts override.

        parts: parts in the order in which their hooks are called.
        flushed: returns the context in which hooks run if a part reads the model, such as `Run.flushed_view`, in which
            no block of rows has a step to catch up on.
        """
        self._flushed = flushed
        self._due, self._measured, self._stepped, self._ended = (
            overrides(parts, hook) for hook in ("due", "measured", "stepped", "ended")
        )

    def begins(self, at: Iteration) -> None:
        at.due = at.changes
        # A list, so that each part is asked in every iteration, whatever the others answer.
        at.read = any([due(at) for due in self._due])
        at.due |= at.read

    def measured(self, at: Iteration, losses: Losses) -> None:
        with self._flushed() if at.read else nullcontext():
            for notify in self._measured:
                notify(at, losses)

    def stepped(self, at: Iteration) -> None:
        with self._flushed() if at.read or at.stopping else nullcontext():
            for notify in self._stepped:
                notify(at)

    def ended(self, error: Error = None) -> None:
        for notify in self._ended:
            notify(error)

    def __enter__(self) -> "Announcer":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: Error, trace: TracebackType | None) -> None:
        if error is not None:
            self.ended(error)


# What a plain step does besides, where poses are trained or rows sleep


def _keep_planes(package: dict[str, Tensor | None], run: Run) -> list[Tensor | None]:
    """Keep the gradients of image and depth before exposures, for the step of a camera; [] if no camera is trained."""
    if not run.camera_steps:
        return []
    planes = [package["render"], package["depth"]]
    for plane in planes:
        if plane is not None:
            plane.retain_grad()
    return planes


def _step_camera(run: Run, at: Iteration, planes: list[Tensor | None]) -> None:
    color, depth = (None if plane is None else plane.grad for plane in planes)
    drawn = draw(at.camera, run.gaussians, run.pipe, at.background, depth is not None)
    run.step_camera(at, drawn.camera_gradient(color, to_world_units(depth, run.gaussians)))


def _prepare_rows(run: Run, at: Iteration) -> None:
    """Place a trained camera, and wake the blocks of rows that the step concerns.

    Blocks that a view does not show sleep: they miss steps, and take these once they wake (scene/sleeping.py). All
    blocks wake where rows change, or where no step follows.
    """
    if run.camera_steps:
        run.camera_steps.place(at.camera)
    if not run.sleeping:
        return
    if at.changes or not at.steps:
        run.sleeping.flush()
    else:
        wake(run.sleeping, at.camera, run.gaussians, run.pipe, at.background)
        run.gaussians.optimizer.rows = run.sleeping.rows()


def _reaches_sleepers(run: Run) -> bool:
    """Tell whether a row that sleeps has a gradient, because somebody has added a term to the loss."""
    rows = run.sleeping and run.gaussians.optimizer.rows
    if rows is None:
        return False
    gradients = [run.gaussians.raw(name).grad for name in run.gaussians._attributes]
    return any(bool(gradient[~rows].any()) for gradient in gradients if gradient is not None)


def _stop_skipping(run: Run) -> None:
    """Wake all blocks of rows for good, and drop the gradients of a step that will be taken again."""
    run.gaussians.drop_gradients()
    run.gaussians.optimizer.rows = None
    run.stop_skipping()
