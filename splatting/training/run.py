"""A training run: scene, model, objective and density control, made and checked before a file is written."""

import argparse
import copy
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch

from arguments import add_to_model_json, write_cfg_args
from gaussian_renderer.rays import check_views
from scene.gaussian_model import GaussianModel
from scene.gaussians.checkpoint import extra_state, load_checkpoint, with_extra_state
from scene.gaussians.morton import sort_rows
from scene.scene import Scene
from scene.splats.splats import Splats
from scene.with_splats import scene_with, start_from
from splatting.distributed.ranks import ranks
from splatting.evaluation.training_log import Stopwatch
from splatting.files.json_files import SCHEDULE
from splatting.host.interrupt import DeferredInterrupt
from splatting.part import Strategy
from splatting.registry import check_together, chosen, in_order, part_class, states_in, strategy_part
from splatting.training import checks, earlier_runs
from splatting.training.consistency import agree_on_scene
from splatting.training.density import density_control
from splatting.training.iteration import ViewOrder
from splatting.training.memory_estimate import announce_memory
from splatting.training.objective import LossWatch, Objective
from splatting.training.restart import resumed
from splatting.training.schedule import Schedule
from splatting.training.stepping import Stepping
from splatting.training.strategy_warnings import warnings_of
from splatting.training.trim_report import TrimReport, trimmed
from utils.system_utils import UserError, compute_device


class Run(Stepping):
    """The objects that the loop and its observers share, besides those of `Stepping`.

    dataset, opt, pipe, launch: the options; group: the processes that train together; start: a chkpntN.pth that is
    resumed, or None. From `begin` on: log, rows (of the curve so far), losses (running mean of the total) and clock
    (seconds of training). interrupt: a signal that asks the loop to stop; an
    observer that waits has to look at it. resources: what parts have open, closed when the training is over, however it
    ends. report: `training_report`, or what replaces it; writer: its first argument. joules: what the clock reads
    (host/energy.py). checkpoints: writes them, while the loop runs.
    grown: whether the scene has more photos than the checkpoint was trained on.
    """

    writer: Any = None
    report: Any = None
    joules: Callable[[], float] | None = None
    checkpoints: Any = None
    grown = False

    def __init__(
        self, dataset: argparse.Namespace, opt: argparse.Namespace, pipe: argparse.Namespace, launch: argparse.Namespace
    ) -> None:
        """Read and check everything that can be refused; nothing is written. UserError for what is refused.

        launch: the options of splatting/training/launch.py.
        """
        given, opt = opt, copy.copy(opt)  # of which the strategy, and windows by the clock, are decided here
        self.opt, self.pipe, self.launch = opt, pipe, launch
        self.group = ranks()
        checks.check_alone(getattr(pipe, "projection", "ewa"), self.group.several)
        self.start = self.group.shared(resumed(launch.start_checkpoint, dataset.model_path, opt.iterations))
        checks.check_lenses(dataset)  # before auto becomes native
        dataset = self.dataset = earlier_runs.resolve_lenses(dataset, self.start)
        if opt.strategy == "auto" and self.start:
            opt.strategy = earlier_runs.strategy_of(self.start)
        self.resources = ExitStack()
        self.interrupt, self.device = DeferredInterrupt(), compute_device()
        self.gaussians = GaussianModel(dataset.sh_degree, opt.optimizer_type)
        capture, self.first_iteration = self._read_start()
        self.schedule = Schedule(opt.iterations)
        states = self._choose_parts(capture)
        if self.schedule.is_over(self.first_iteration):
            raise UserError(self.schedule.nothing_left(self.start, self.first_iteration))
        self.scene, first = self._read_scene()
        self.gaussians.enlargement = earlier_runs.enlargement_of(self.start, self.gaussians.enlargement)
        checks.check_scene(self.scene, dataset, bool(self.start))
        agree_on_scene(self.scene, self.start)  # before an image is shared
        count = len(capture[1] if capture else self.scene.info.point_cloud.points if first is None else first)
        self.gaussians.divide(self.group)
        self.gaussians.room.expect(-(-count // self.group.size), self.scene)
        self.views = ViewOrder(self.scene.getTrainCameras(), opt.seed)
        self.decode_ahead(self.first_iteration + 1)
        self.background = torch.full((3,), 1.0 if dataset.white_background else 0.0, device=self.device)
        self._begin_model(capture, first, states)
        check_views(self.pipe, self.scene.getTrainCameras(), self.sizes.smallest)
        check_views(self.pipe, self.scene.getTestCameras())
        self._check_records()
        self.density = density_control(self, self._choose_strategy(states))
        self.objective = Objective(self)
        self.warnings = [f"warning: {text}" for text in warnings_of(self, given)]
        for text in self.warnings:
            print(text, file=sys.stderr)
        for ready in self.each("ready"):
            ready(self)
        if capture is None and first is None:
            self.density.started()

    def _choose_parts(self, capture: tuple | None) -> dict[str, Any]:
        """Choose the parts by the options and by a checkpoint, and let them check both. Returns the states by name."""
        given, states = self._all_options, states_in(extra_state(capture)) if capture else {}
        self.parts = chosen(given, states)
        check_together(self.parts, given, self.group.several)
        for name in states.keys() - {part.name for part in self.parts}:
            if text := part_class(name).dropped(given, self.first_iteration):
                print(f"warning: {text}", file=sys.stderr)
        for check in self.each("check"):
            check(self, states.get(check.__self__.name))
        return states

    def _read_start(self) -> tuple[tuple | None, int]:
        """The state of the checkpoint that is resumed, on the host, and its iteration."""
        # A large model fits on the device only once, or in part; of several processes, each keeps its part there.
        return load_checkpoint(self.start, mapped=self.group.several) if self.start else (None, 0)

    def _read_scene(self) -> tuple[Scene, Splats | None]:
        """The scene of the empty model, and the splats of --init_ply in its frame, None without them."""
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
        """Let the strategy join, now that the schedule and the model may say which it is."""
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
        return strategy

    def _check_records(self) -> None:
        """Compare this run with those before it, in its folder and beside its checkpoint."""
        start = self.start
        saves = [self.schedule.known(one) for one in (self.launch.save_iterations, self.launch.checkpoint_iterations)]
        earlier_runs.check_folder(self.options, saves[0], start, self.first_iteration, saves[1])
        if start:
            earlier_runs.report_changes(start, self.options, self.grown)

    @property
    def _all_options(self) -> argparse.Namespace:
        """Those of all groups, as they are in force, and of the launch, which may have all as they were given."""
        return argparse.Namespace(**vars(self.launch) | vars(self.options))

    @property
    def options(self) -> argparse.Namespace:
        """All options of the three groups, as they are in force."""
        return argparse.Namespace(**vars(self.dataset) | vars(self.opt) | vars(self.pipe))

    @property
    def entries(self) -> dict[str, Any]:
        """Entries of model.json besides the options (`write_model_json`)."""
        return self.gaussians.frame | self.facts

    @property
    def facts(self) -> dict[str, Any]:
        """What parts keep in model.json."""
        return {name: fact for facts in self.each("facts") for name, fact in facts().items()}

    def begin(self) -> None:
        """Write the inputs into the output folder, print the memory estimate, start or continue the log."""
        folder, start = self.scene.model_path, self.start
        if not earlier_runs.lies_in(start, folder) or not (Path(folder) / "cameras.json").exists():
            self.scene.write_inputs()
        if self.group.first and not self.schedule.paced:
            (Path(folder) / SCHEDULE).unlink(missing_ok=True)
        wants = self.density.max_gaussians, self.density.absolute_gradients
        announce_memory(self.scene, self.gaussians, *wants, self.group.size)
        self.log, self.rows = earlier_runs.continue_records(folder, start, self.first_iteration)
        self.losses = LossWatch(self.log.loss)
        self.clock = Stopwatch(self.joules)
        for opened in self.each("opened"):
            opened(self)

    def checkpoint_state(self) -> tuple:
        """The state of the model for a checkpoint, from which a training resumes. Every rank must call it."""
        state = self.gaussians.capture()
        states = {part.name: part.state() for part in self.parts}
        return with_extra_state(state, {key: found for key, found in states.items() if found is not None})

    def save_last(self, iteration: int, scored: bool) -> TrimReport:
        """Save the model without what it does not need, and what parts keep in model.json. Returns what is left out.

        scored: as for `trimmed`.
        """
        (model, left_out), scene = trimmed(self, scored, iteration), self.scene
        scene.save(iteration, model)
        write_cfg_args(scene.model_path, argparse.Namespace(**vars(self.dataset) | {"sh_degree": model.max_sh_degree}))
        add_to_model_json(scene.model_path, **self.facts, left_out=vars(left_out))
        return left_out
