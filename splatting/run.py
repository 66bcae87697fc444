"""A training run: scene, model, objective and density control, made and checked before a file is written."""

import argparse
import copy
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from itertools import count
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from arguments import add_to_model_json, write_cfg_args
from gaussian_renderer.rays import check_views
from groundwork.deterministic.counter_rng import Stream, uniform
from groundwork.files.json_files import SCHEDULE
from groundwork.files.similarity import ENTRY, read_orientation
from groundwork.host.clock import seconds_since_start
from groundwork.host.energy import joules_counter, nvml_name
from groundwork.host.interrupt import DeferredInterrupt
from groundwork.ranks.ranks import ranks
from scene.checks.scene import check_scene
from scene.gaussian_model import GaussianModel
from scene.gaussians.adam import GaussianAdam, SparseGaussianAdam
from scene.gaussians.checkpoint import extra_state, load_checkpoint, with_extra_state
from scene.gaussians.morton import sort_rows
from scene.gaussians.sh_bands import SH_INTERVAL
from scene.scene import Scene
from scene.sleeping import Sleeping
from scene.splats.splats import Splats
from scene.with_splats import scene_with, start_from
from splatting import folder
from splatting.agreement import agree_on_scene
from splatting.checks import check_alone, check_native, warnings_of
from splatting.iteration import Iteration, OwnSize, ViewOrder
from splatting.objective import LossWatch, Objective
from splatting.part import Part, Strategy, overrides
from splatting.records.error_curve import Row
from splatting.records.training_log import Stopwatch, TrainingLog
from splatting.registry import PARTS, check_together, chosen, in_order, states_in, strategies, strategy_part
from splatting.resources import announce_memory
from splatting.save import Checkpoints
from splatting.schedule import USUAL, Schedule
from splatting.trim_report import TrimReport, trimmed
from splatting.watch import DivergenceWatch, check_drawn
from utils.system_utils import UserError, compute_device


class Run:
    """The objects that the loop and its observers share, and the questions that an iteration asks about them.

    dataset, opt, pipe, launch: options.
    scene, gaussians, objective, strategy, schedule: made by the options.
    views: training cameras by iteration.
    background: (3,), colour.
    parts: parts of the run, in their order.
    strategies: classes of all strategies that exist.
    group: processes that train together.
    start: path of the chkpntN.pth that is resumed, or None.
    first_iteration: number of iterations done before this run.
    sleeping, sizes, pixel_filter, camera_steps, has_new_photos: slots that parts fill (splatting/part.py).
    interrupt: signal that asks the loop to stop. An observer that waits has to check it.
    resources: files and the like that parts have open, closed when the training is over, however it ends.
    warnings: warnings that were printed.
    log: training log.
    rows: rows of the curve so far.
    losses: running mean of the total loss.
    clock: seconds of training. `open` starts log, rows, losses and clock, or continues those of a resumed run.
    watch: ends a training that diverges.
    checkpoints: writes checkpoints.
    writer, report: arguments of `open`.
    first_done: seconds from the process's start to the end of its first iteration; None: the system does not say.
    """

    def __init__(
        self, dataset: argparse.Namespace, opt: argparse.Namespace, pipe: argparse.Namespace, launch: argparse.Namespace
    ) -> None:
        """Read and check everything that can be refused (UserError); nothing is written.

        launch: the options of arguments/launch.py.
        """
        given, opt = opt, copy.copy(opt)  # of which the strategy, and windows by the clock, are decided here
        self.opt, self.pipe, self.launch = opt, pipe, launch
        self.group = ranks()
        check_alone(getattr(pipe, "projection", "ewa"), self.group.several)
        self.start = self.group.broadcast_object(
            folder.resumed(launch.start_checkpoint, dataset.model_path, opt.iterations)
        )
        check_native(dataset)  # before auto becomes native
        dataset = self.dataset = folder.resolve_lenses(dataset, self.start)
        if opt.strategy == "auto" and self.start:
            opt.strategy = folder.strategy_of(self.start)
        self.resources = ExitStack()
        self.interrupt, self.device = DeferredInterrupt(), compute_device()
        self.gaussians = GaussianModel(dataset.sh_degree, opt.optimizer_type)
        capture, self.first_iteration = self._read_start()
        self.schedule = Schedule(opt.iterations)
        self._fill_slots()
        states = self._choose_parts(capture)
        self._orientation = read_orientation(Path(dataset.source_path))
        if self.schedule.is_over(self.first_iteration):
            raise UserError(self.schedule.nothing_left(self.start, self.first_iteration))
        self.scene, first = self._read_scene()
        self.gaussians.enlargement = folder.enlargement_of(self.start, self.gaussians.enlargement)
        check_scene(self.scene, dataset, bool(self.start))
        agree_on_scene(self.scene, self.start)  # before an image is shared
        count = len(capture[1] if capture else self.scene.info.point_cloud.points if first is None else first)
        self.gaussians.divide(self.group)
        self.gaussians.storage.reserve(-(-count // self.group.size), self.scene)
        self.views = ViewOrder(self.scene.getTrainCameras(), opt.seed)
        self.decode_ahead(self.first_iteration + 1)
        self.background = torch.full((3,), 1.0 if dataset.white_background else 0.0, device=self.device)
        self._begin_model(capture, first, states)
        check_views(self.pipe, self.scene.getTrainCameras(), self.sizes.smallest)
        check_views(self.pipe, self.scene.getTestCameras())
        if capture is None:
            check_drawn(self)
        self._check_records()
        self.strategy = self._choose_strategy(states)
        self.objective = Objective(self)
        self.warnings = [f"warning: {text}" for text in warnings_of(self, given)]
        for text in self.warnings:
            print(text, file=sys.stderr)
        for ready in self.each("ready"):
            ready(self)
        if capture is None and first is None:
            self.strategy.started()
        self._prepare_records()

    def _fill_slots(self) -> None:
        """Set the defaults of the slots that parts read and may fill."""
        self.strategies = strategies()
        self.parts: Sequence[Part] = ()
        self._hooks: dict[str, list[Callable]] = {}
        self.sleeping: Sleeping | None = None
        self.sizes: Any = OwnSize()
        self.pixel_filter = self.camera_steps = None
        self.has_new_photos = False

    def _prepare_records(self) -> None:
        """Make the records of a new training. `open` replaces them where a training is resumed."""
        self.log, self.clock, self.losses = TrainingLog(self.scene.model_path), Stopwatch(), LossWatch()
        self.rows: list[Row] = []
        self.watch, self.checkpoints = DivergenceWatch(self), Checkpoints(self)
        self.writer = self.report = None
        self.first_done: float | None = None

    def _choose_parts(self, capture: tuple | None) -> dict[str, Any]:
        """Choose the parts by options and checkpoint, and let the parts check both. Return the states by name."""
        given, states = self._all_options, states_in(extra_state(capture)) if capture else {}
        self.parts = chosen(given, states)
        check_together(self.parts, given, self.group.several)
        for part in PARTS:
            dropped = part.name in states and part.name not in {there.name for there in self.parts}
            if dropped and (text := part.dropped(given, self.first_iteration)):
                print(f"warning: {text}", file=sys.stderr)
        for check in self.each("check"):
            check(self, states.get(check.__self__.name))
        return states

    def _read_start(self) -> tuple[tuple | None, int]:
        """Return the state of the checkpoint that is resumed, on the host, and its iteration."""
        # A large model fits on the device only once, or in part; of several processes, each keeps its part there.
        return load_checkpoint(self.start, mapped=self.group.several) if self.start else (None, 0)

    def _read_scene(self) -> tuple[Scene, Splats | None]:
        """Return the scene of the empty model, and the splats of --init_ply in the scene's frame, or None."""
        init_ply = None if self.start else getattr(self.dataset, "init_ply", None)
        options = {"ranks": self.group, "parts": self.parts}
        if init_ply:
            return scene_with(init_ply, self.dataset, self.gaussians, **options)
        return Scene(self.dataset, self.gaussians, shuffle=False, start=False, **options), None

    def _begin_model(self, capture: tuple | None, first: Splats | None, states: dict[str, Any]) -> None:
        """Start the model from the state of a checkpoint, from a file's splats, or from the dataset's points."""
        if capture is not None:
            self.gaussians.start_exposures(self.scene.info.train_cameras)
            self.gaussians.restore(capture, self.opt)
            for begin in self.each("begin"):
                begin(self, states.get(begin.__self__.name))
        else:
            if first is None:
                self.scene.create_gaussians()
            else:
                start_from(first, self.scene, self.gaussians)
            for begin in self.each("begin"):
                begin(self, None)
            self.gaussians.training_setup(self.opt)
            sort_rows(self.gaussians)
        self.parts = [part for part in self.parts if part.active]
        self._hooks.clear()
        self.gaussians.limit_columns()

    def _choose_strategy(self, states: dict[str, Any]) -> Strategy:
        """Choose the strategy by the option, the schedule or the model, and add it to the parts."""
        opt = self.opt
        if opt.strategy == "auto":
            opt.strategy = self.schedule.best_strategy(self)
        self.schedule.strategy = opt.strategy
        strategy = strategy_part(opt.strategy)
        self.parts = in_order([*self.parts, strategy])
        self._hooks.clear()
        check_together(self.parts, self._all_options, self.group.several)
        strategy.check(self, states.get(strategy.name))
        strategy.begin(self, states.get(strategy.name))
        if strategy.seen_only:
            self.gaussians.step_sparsely()
        return strategy

    def _check_records(self) -> None:
        """Compare this run with earlier runs, in its folder and beside its checkpoint."""
        start = self.start
        saves = [self.schedule.known(one) for one in (self.launch.save_iterations, self.launch.checkpoint_iterations)]
        folder.check_folder(self.options, saves[0], start, self.first_iteration, saves[1])
        if start:
            folder.report_changes(start, self.options, self.has_new_photos)

    @property
    def _all_options(self) -> argparse.Namespace:
        """The options of all groups, as they are in force, and of the launch, which may repeat them as given."""
        return argparse.Namespace(**vars(self.launch) | vars(self.options))

    @property
    def options(self) -> argparse.Namespace:
        """The options of the groups model, optimisation and pipeline, as they are in force."""
        return argparse.Namespace(**vars(self.dataset) | vars(self.opt) | vars(self.pipe))

    @property
    def entries(self) -> dict[str, Any]:
        """Entries of model.json besides the options (`write_model_json`)."""
        return self.gaussians.frame | self.facts

    @property
    def facts(self) -> dict[str, Any]:
        """Entries of model.json by parts, and where the scene stands upright, for exports (convert.py --orient)."""
        found = {name: fact for facts in self.each("facts") for name, fact in facts().items()}
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
        wants = self.strategy.max_gaussians, self.strategy.absolute_gradients
        announce_memory(self.scene, self.gaussians, *wants, self.group.size)
        self.log, self.rows = folder.continue_records(to, start, self.first_iteration)
        self.losses.mean = self.log.loss
        self.clock = Stopwatch(joules_counter(self.group.all_gather_objects(nvml_name(self.device))))
        for opened in self.each("opened"):
            opened(self)

    def checkpoint_state(self) -> tuple:
        """Return the state of model and parts from which a training resumes. Every rank must call it."""
        state = self.gaussians.capture()
        states = {part.name: part.state() for part in self.parts}
        return with_extra_state(state, {key: found for key, found in states.items() if found is not None})

    def save_last(self, iteration: int, scored: bool) -> TrimReport:
        """Save the model without what it does not need, and the parts' entries of model.json. Return what is left out.

        scored: as for `trimmed`.
        """
        (model, left_out), scene = trimmed(self, scored, iteration), self.scene
        scene.save(iteration, model)
        write_cfg_args(scene.model_path, argparse.Namespace(**vars(self.dataset) | {"sh_degree": model.max_sh_degree}))
        add_to_model_json(scene.model_path, **self.facts, left_out=vars(left_out))
        return left_out

    # What an iteration asks

    def each(self, hook: str) -> list[Callable]:
        """Return the parts' bound hooks of a name."""
        if hook not in self._hooks:
            self._hooks[hook] = overrides(self.parts, hook)
        return self._hooks[hook]

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
            at = Iteration(
                iteration,
                last=last,
                rests=schedule.rests(iteration),
                camera=camera,
                background=self._background(iteration),
                changes=self._changes(iteration),
                started=seconds,
                span=range(span.start, schedule.length + 1) if last else span,
            )
            self.add_terms(at)
            yield at
            if iteration == self.first_iteration + 1:
                self.first_done = seconds_since_start()
            if at.last:
                return

    def add_terms(self, at: Iteration) -> None:
        """Add the terms of parts to the loss of a step."""
        for terms in self.each("terms"):
            if found := terms(at):
                at.terms |= found
                at.wants_depth |= terms.__self__.needs.depth
                at.captured &= terms.__self__.needs.captured

    def _changes(self, iteration: int) -> bool:
        changes = any(changes(iteration) for changes in self.each("changes"))
        return self._raises_degree(iteration) > 0 or changes

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
        self.gaussians.exposures.held = self.strategy.recovers(at.iteration)
        self.gaussians.update_learning_rate(self.schedule.schedule_step(at.iteration))
        factor, bands = self.schedule.rate_factor(at.iteration), self.strategy.band_rate
        if factor is None:
            factor = self.strategy.rate_factor(at.iteration)
        if factor is not None:
            sparse = isinstance(self.gaussians.optimizer, SparseGaussianAdam)
            factor *= bias_correction(at.iteration) if sparse else 1.0
        if factor is not None or bands != 1:
            self.gaussians.scale_rates(1.0 if factor is None else factor, bands)
        beta2, optimizer = self.strategy.beta2(at.iteration), self.gaussians.optimizer
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
        """Let parts act after the optimiser's step."""
        for after_step in self.each("after_step"):
            after_step(at)

    def flushed_view(self) -> AbstractContextManager:
        """Return a context in which others may read the model."""
        return nullcontext() if self.sleeping is None else self.sleeping.flushed_view()

    def stop_skipping(self) -> None:
        """Let all blocks take the steps that they have missed, and let none sleep from now on."""
        if self.sleeping is not None:
            self.sleeping.flush()
        self.sleeping = None

    def render_options(self, at: Iteration) -> dict[str, bool]:
        """Return the options of `render` with which it computes what this step's loss needs, and no more."""
        return {
            "want_depth": at.wants_depth,
            "want_visibility": False,
            "want_inactive_bands": False,
            "want_absolute_gradient": self.strategy.absolute_gradients and self.strategy.observes(at.iteration),
            "clamp": False,
        }


def bias_correction(step: int, beta1: float = 0.9, beta2: float = 0.999) -> float:
    """Return the factor of a step of Adam whose averages began at zero (Kingma and Ba 2015, Section 2), 1/6 to 1.

    Sparse Adam leaves this factor out, as the reference's does; steps that are long already would then be six times as
    long.
    """
    return math.sqrt(1 - beta2**step) / (1 - beta1**step)
