"""A training run as a record: what the loop and its observers share, and what an iteration asks.

A part is a class whose hooks add one feature to a training (splatting/part.py).
"""

import argparse
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass, field
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from arguments import add_to_model_json, write_cfg_args
from groundwork.deterministic.counter_rng import Stream, uniform
from groundwork.files.json_files import SCHEDULE
from groundwork.files.similarity import ENTRY, read_orientation
from groundwork.host.clock import seconds_since_start
from groundwork.host.energy import joules_counter, nvml_name
from groundwork.host.interrupt import DeferredInterrupt
from groundwork.ranks.ranks import Ranks
from scene.gaussian_model import GaussianModel
from scene.gaussians.adam import GaussianAdam, SparseGaussianAdam
from scene.gaussians.checkpoint import with_extra_state
from scene.gaussians.sh_bands import SH_INTERVAL
from scene.scene import Scene
from scene.sleeping import Sleeping
from splatting import folder
from splatting.iteration import Iteration, OwnSize, ViewOrder
from splatting.objective import LossWatch, Objective
from splatting.part import Part, Strategy
from splatting.records.error_curve import Row
from splatting.records.training_log import Stopwatch, TrainingLog
from splatting.resources import announce_memory
from splatting.save import Checkpoints
from splatting.schedule import USUAL, Schedule
from splatting.spill import announce_spilled, release_torch
from splatting.trim_report import TrimReport, trimmed
from splatting.watch import DivergenceWatch


@dataclass(eq=False)
class Run:
    """The objects that the loop and its observers share, and the questions that an iteration asks about them.

    dataset, opt, pipe, launch: options.
    group: processes that train together.
    start: path of the chkpntN.pth that is resumed, or None.
    first_iteration: number of iterations done before this run.
    parts: parts of the run, in their order.
    schedule: steps of the schedule that the iterations stand for.
    views: training cameras by iteration.
    starts_from_points: true if the Gaussians were made of the dataset's points.
    added_photos: record of photos that an earlier run has not seen (splatting/resume_photos.py), or None.
    has_new_photos: true if the checkpoint has not seen them.
    sizes, pixel_filter, camera_steps: slots that parts fill (splatting/part.py).
    sleeping: blocks of rows that take no step (scene/sleeping.py), or None.
    interrupt: signal that asks the loop to stop. An observer that waits has to check it.
    resources: files and the like that observers have open, closed when the training is over, however it ends.
    losses: running mean of the total loss.
    first_done: seconds from the process's start to the end of its first iteration; None: the system does not say.
    strategy, objective: density control and loss.
    warnings: warnings that were printed.
    watch: ends a training that diverges.
    checkpoints: writes checkpoints.
    log: training log.
    rows: rows of the curve so far.
    clock: seconds of training. `open` makes log, rows and clock, which continue those of a resumed run.
    writer, report: arguments of `open`.
    """

    dataset: argparse.Namespace
    opt: argparse.Namespace
    pipe: argparse.Namespace
    launch: argparse.Namespace
    group: Ranks
    device: torch.device
    start: str | None
    first_iteration: int
    parts: Sequence[Part]
    schedule: Schedule
    scene: Scene
    gaussians: GaussianModel
    views: ViewOrder
    starts_from_points: bool = False
    added_photos: dict[str, Any] | None = None
    has_new_photos: bool = False
    sizes: Any = field(default_factory=OwnSize)
    pixel_filter: Any = None
    camera_steps: Any = None
    sleeping: Sleeping | None = None
    interrupt: DeferredInterrupt = field(default_factory=DeferredInterrupt)
    resources: ExitStack = field(default_factory=ExitStack)
    losses: LossWatch = field(default_factory=LossWatch)
    first_done: float | None = None
    strategy: Strategy = field(init=False)
    objective: Objective = field(init=False)
    warnings: list[str] = field(init=False)
    watch: DivergenceWatch = field(init=False)
    checkpoints: Checkpoints = field(init=False)
    log: TrainingLog = field(init=False)
    rows: list[Row] = field(init=False)
    clock: Stopwatch = field(init=False)
    writer: Any = None
    report: Callable | None = None

    def __post_init__(self) -> None:
        white = 1.0 if self.dataset.white_background else 0.0
        self.background = torch.full((3,), white, device=self.device)
        self._orientation = read_orientation(Path(self.dataset.source_path))  # which may be gone later

    @property
    def options(self) -> argparse.Namespace:
        """The options of the groups model, optimisation and pipeline, as they are in force."""
        return join_options(self.dataset, self.opt, self.pipe)

    @property
    def entries(self) -> dict[str, Any]:
        """Entries of model.json besides the options (`write_model_json`)."""
        return self.gaussians.frame | self.facts

    @property
    def facts(self) -> dict[str, Any]:
        """Entries of model.json by parts, and where the scene stands upright, for exports (convert.py --orient)."""
        found = {name: fact for part in self.parts for name, fact in part.facts().items()}
        return found | ({ENTRY: self._orientation} if self._orientation else {})

    def open(self, writer: Any = None, report: Callable | None = None) -> None:
        """Write the inputs into the output folder, print the memory estimate, and start the clock.

        writer: first argument of `report`.
        report: `training_report`, or a function in its place.
        """
        self.writer, self.report = writer, report
        to, start = self.scene.model_path, self.start
        if not folder.lies_in(start, to) or not (Path(to) / "cameras.json").exists():
            self.scene.write_inputs()
        if self.group.first and not self.schedule.paced:
            (Path(to) / SCHEDULE).unlink(missing_ok=True)
        wants = self.strategy.max_gaussians, self.strategy.takes_absolute(self.opt)
        announce_memory(self.scene, self.gaussians, *wants, self.group.size)
        self.log, self.rows = folder.continue_records(to, start, self.first_iteration)
        self.losses.mean = self.log.loss
        self.clock = Stopwatch(joules_counter(self.group.all_gather_objects(nvml_name(self.device))))
        if storage := self.gaussians.storage:
            announce_spilled(self, storage)
            storage.rebalance(self.gaussians)
            self.resources.callback(release_torch)
        if writer is not None:
            self.resources.callback(writer.close)

    def checkpoint_state(self) -> tuple:
        """Return the state of model and parts from which a training resumes. Every rank must call it."""
        state = self.gaussians.capture()
        states = {part.name: part.state() for part in self.parts}
        states |= {"sleep": self.sleeping and self.sleeping.captured(), "resume": self.added_photos}
        return with_extra_state(state, {key: found for key, found in states.items() if found is not None})

    def save_last(self, iteration: int, scored: bool) -> TrimReport:
        """Save the model without what it does not need, and the parts' entries of model.json. Return what is left out.

        scored: true to compute how much PSNR the test views lose by it.
        """
        (model, left_out), scene = trimmed(self, scored, iteration), self.scene
        scene.save(iteration, model)
        write_cfg_args(scene.model_path, argparse.Namespace(**vars(self.dataset) | {"sh_degree": model.max_sh_degree}))
        add_to_model_json(scene.model_path, **self.facts, left_out=vars(left_out))
        return left_out

    # What an iteration asks

    @cached_property
    def _terms_hooks(self) -> list[Callable]:
        """Hooks `terms` of the parts that have one."""
        return overrides(self.parts, "terms")

    @cached_property
    def _after_step_hooks(self) -> list[Callable]:
        """Hooks `after_step` of the parts that have one."""
        return overrides(self.parts, "after_step")

    @property
    def is_standard(self) -> bool:
        """True if loss and density control need gradients of the image alone, and the kernels compute all else.

        Subclasses do not inherit `fusable` of an objective or a strategy; each class must say so itself.
        """
        own = all(vars(type(one)).get("fusable", False) for one in (self.objective, self.strategy))
        return own and not (self.pipe.compute_cov3D_python or self.pipe.convert_SHs_python)

    def iterations(self) -> Iterator[Iteration]:
        """Yield the iterations of this run."""
        for iteration in count(self.first_iteration + 1):
            seconds, schedule = self.clock.seconds, self.schedule
            schedule.reach(iteration, self.log.seconds_before + seconds)
            camera = self.sizes.view(self.views[iteration], schedule.schedule_step(iteration))
            span, last = schedule.span(iteration), schedule.is_last(iteration)
            density = self.strategy.actions(iteration)
            at = Iteration(
                iteration,
                last=last,
                rests=schedule.rests(iteration),
                camera=camera,
                background=self._background(iteration),
                changes=density.changes or self._changes(iteration),
                started=seconds,
                span=range(span.start, schedule.length + 1) if last else span,
                density=density,
            )
            self.add_terms(at)
            yield at
            if iteration == self.first_iteration + 1:
                self.first_done = seconds_since_start()
            if at.last:
                return

    def add_terms(self, at: Iteration) -> None:
        """Add the terms of parts to the loss of a step."""
        for terms in self._terms_hooks:
            if found := terms(at):
                at.terms |= found
                at.wants_depth |= terms.__self__.needs.depth
                at.captured &= terms.__self__.needs.captured

    def _changes(self, iteration: int) -> bool:
        """Tell whether an iteration has a higher SH degree, or other sizes of views, than the one before it."""
        before, now = (self.sizes.factor_at(self.schedule.schedule_step(t)) for t in (iteration - 1, iteration))
        return before != now or self._raises_degree(iteration) > 0

    def _raises_degree(self, iteration: int) -> int:
        """Count the raises of the SH degree in an iteration; in a long steady run also those beyond the highest degree.

        All blocks of rows wake at a raise, which decides how values of rows that sleep are rounded.
        """
        schedule, gaussians = self.schedule, self.gaussians
        short = schedule.length < SH_INTERVAL
        if (schedule.paced or short) and gaussians.active_sh_degree == gaussians.max_sh_degree:
            return 0
        every = max(schedule.length * SH_INTERVAL // USUAL, 1) if short else SH_INTERVAL
        before, now = (schedule.schedule_step(t) // every for t in (iteration - 1, iteration))
        return now - before

    def _background(self, iteration: int) -> Tensor:
        if not self.opt.random_background:
            return self.background
        draws = uniform(self.opt.seed, Stream.BACKGROUND, iteration, torch.zeros(1, dtype=torch.int64))
        return draws[0, :3].to(self.device)

    def prepare(self, at: Iteration) -> None:
        """Set learning rates and SH degree, and begin to decode the photos of the next views."""
        self.set_rates(at)
        for _ in range(self._raises_degree(at.iteration)):
            self.gaussians.oneupSHdegree()
            self.gaussians.limit_columns()
        if at.iteration - 1 == self.launch.debug_from:
            self.pipe.debug = True
        self.decode_ahead(at.iteration)

    def set_rates(self, at: Iteration) -> None:
        """Set the learning rates of a step, which may be a repeated one."""
        self.gaussians.exposures.held = at.density.recovers
        self.gaussians.update_learning_rate(self.schedule.schedule_step(at.iteration))
        factor, bands, beta2 = self.strategy.rates(at.iteration)
        if (scheduled := self.schedule.rate_factor(at.iteration)) is not None:
            factor = scheduled
        optimizer = self.gaussians.optimizer
        if factor is not None and isinstance(optimizer, SparseGaussianAdam):
            factor *= bias_correction(at.iteration)
        if factor is not None or bands != 1:
            self.gaussians.scale_rates(1.0 if factor is None else factor, bands)
        if beta2 is not None and isinstance(optimizer, GaussianAdam):
            optimizer.set_beta2(beta2)

    def decode_ahead(self, iteration: int) -> None:
        """Begin to decode the photos of an iteration and of those that follow it."""
        ahead = self.scene.images.ahead
        if (last := self.schedule.ends) is not None:
            ahead = min(ahead, last - iteration + 1)
        self.scene.prefetch(list(filter(self.sizes.needs, self.views.coming(iteration, ahead))))

    def step_camera(self, at: Iteration, gradient: Tensor) -> None:
        """Take the step of the view's camera.

        gradient: (numbers,), of the loss by the camera's numbers.
        """
        step = self.schedule.schedule_step(at.iteration)
        self.camera_steps.step(at.camera.uid, gradient.cpu().numpy(), step)
        self.camera_steps.place()

    def after_step(self, at: Iteration) -> None:
        """Let parts act after the optimiser's step, then the storage of rows, and the blocks that sleep."""
        for act in self._after_step_hooks:
            act(at)
        if at.changes and self.gaussians.storage:
            self.gaussians.storage.rebalance(self.gaussians)
        if self.sleeping is not None:
            self.gaussians.optimizer.rows = None
            self.sleeping.after_step(at.iteration, at.changes)

    def flushed_view(self) -> AbstractContextManager:
        """Return a context in which others may read the model."""
        return nullcontext() if self.sleeping is None else self.sleeping.flushed_view()

    def stop_skipping(self) -> None:
        """Let the blocks of rows that sleep take the steps that they have missed, and let none sleep from now on."""
        if self.sleeping is not None:
            self.sleeping.flush()
        self.sleeping = None

    def render_options(self, at: Iteration) -> dict[str, bool]:
        """Return the options of `render` with which it computes what this step's loss needs, and no more."""
        return {
            "want_depth": at.wants_depth,
            "want_visibility": False,
            "want_inactive_bands": False,
            "want_absolute_gradient": at.density.observe and self.strategy.takes_absolute(self.opt),
            "clamp": False,
        }


def join_options(*groups: argparse.Namespace) -> argparse.Namespace:
    """Return the options of all groups; a later group goes before an earlier one."""
    return argparse.Namespace(**{name: value for group in groups for name, value in vars(group).items()})


def overrides(parts: Sequence[Part], hook: str) -> list[Callable]:
    """Return the bound hooks of the parts whose class overrides a hook."""
    plain = getattr(Part, hook)
    return [getattr(part, hook) for part in parts if getattr(type(part), hook) is not plain]


def bias_correction(step: int, beta1: float = 0.9, beta2: float = 0.999) -> float:
    """Return the factor of a step of Adam whose averages began at zero (Kingma and Ba 2015, Section 2), 1/6 to 1.

    Sparse Adam leaves this factor out, as the reference's does; steps that are long already would then be six times as
    long.
    """
    return math.sqrt(1 - beta2**step) / (1 - beta1**step)
