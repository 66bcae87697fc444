"""Make a training run of options: scene, model and density control, all checked before a file is written."""

import argparse
import sys
from typing import Any

from gaussian_renderer.rays import check_views
from scene.checks.scene import check_scene
from scene.fused_adam import FusedAdam
from scene.gaussians.adam import GaussianAdam
from scene.gaussians.morton import sort_rows
from scene.sleeping import Sleeping, saves_time
from scene.splats.splats import Splats
from scene.with_splats import scene_with, start_from
from splatting import folder
from splatting.agreement import agree_on_scene
from splatting.checks import check_native, warnings_of
from splatting.iteration import ViewOrder
from splatting.objective import Objective
from splatting.part import Strategy
from splatting.plan import plan_run
from splatting.registry import check_together, in_order, strategies, strategy_part
from splatting.resume import warn_of_finished
from splatting.resume_photos import order_views
from splatting.run import Run, join_options
from splatting.save import Checkpoints
from splatting.watch import DivergenceWatch, check_drawn


def make_run(
    dataset: argparse.Namespace, opt: argparse.Namespace, pipe: argparse.Namespace, launch: argparse.Namespace
) -> Run:
    """Make a run of these options. Refuse what can be refused (UserError); nothing is written.

    launch: the options of arguments/launch.py.
    """
    check_native(dataset)  # before auto becomes native
    given, plan = opt, plan_run(dataset, opt, pipe, launch)
    dataset, opt, group, device, start, capture, done, states, parts, schedule, gaussians, init_ply = plan
    scene, splats = scene_with(init_ply, dataset, gaussians, ranks=group, parts=parts)
    gaussians.enlargement = folder.enlargement_of(start, gaussians.enlargement)
    check_scene(scene, dataset, bool(start))
    agree_on_scene(scene, start)  # before an image is shared
    gaussians.divide(group)
    if gaussians.storage:
        rows = capture[1] if capture else scene.info.point_cloud.points if splats is None else splats
        gaussians.storage.limit_for(-(-len(rows) // group.size), scene)
    views = ViewOrder(scene.getTrainCameras(), opt.seed)
    run = Run(dataset, opt, pipe, launch, group, device, start, done, parts, schedule, scene, gaussians, views)
    run.decode_ahead(done + 1)

    _begin_model(run, capture, splats, states)
    check_views(pipe, scene.getTrainCameras(), run.sizes.smallest)
    check_views(pipe, scene.getTestCameras())
    if capture is None:
        check_drawn(run)
    _compare_with_earlier_runs(run)
    run.strategy = _begin_strategy(run, states)
    run.objective = Objective(run)
    run.warnings = [f"warning: {text}" for text in warnings_of(run, given)]
    for text in run.warnings:
        print(text, file=sys.stderr)
    _place_all(run, states.get("sleep"))
    warn_of_finished(run)
    run.watch, run.checkpoints = DivergenceWatch(run), Checkpoints(run)
    return run


def _begin_model(run: Run, capture: tuple | None, splats: Splats | None, states: dict[str, Any]) -> None:
    """Start the model from the state of a checkpoint, from a file's splats, or from the dataset's points."""
    scene, gaussians = run.scene, run.gaussians
    if capture is not None:
        gaussians.start_exposures(scene.info.train_cameras)
        gaussians.restore(capture, run.opt)
    elif splats is not None:
        start_from(splats, scene, gaussians)
    else:
        scene.create_gaussians()
        run.starts_from_points = True
    for part in run.parts:
        part.begin(run, states.get(part.name))
    if capture is None:
        gaussians.training_setup(run.opt)
        sort_rows(gaussians)
    run.parts = [part for part in run.parts if part.active]
    order_views(run, states.get("resume"))
    gaussians.limit_columns()


def _compare_with_earlier_runs(run: Run) -> None:
    """Compare a run with earlier ones, in its folder and beside its checkpoint."""
    saves, checkpoints = map(run.schedule.known, (run.launch.save_iterations, run.launch.checkpoint_iterations))
    folder.check_folder(run.options, saves, run.start, run.first_iteration, checkpoints)
    if run.start:
        folder.report_changes(run.start, run.options, run.has_new_photos)


def _begin_strategy(run: Run, states: dict[str, Any]) -> Strategy:
    """Choose the strategy by the option, the schedule or the model, and add it to the parts."""
    opt = run.opt
    if opt.strategy == "auto":
        opt.strategy = run.schedule.best_strategy(run, strategies())
    run.schedule.strategy = opt.strategy
    strategy = strategy_part(opt.strategy)
    run.parts = in_order([*run.parts, strategy])
    check_together(run.parts, join_options(run.launch, run.options), run.group.several)
    strategy.begin(run, states.get(strategy.name))
    return strategy


def _place_all(run: Run, asleep: Any) -> None:
    """Put cameras where they are trained, rows where there is room for those to come, and blocks to sleep.

    asleep: state of the blocks in the checkpoint, or None.
    """
    strategy, gaussians, storage = run.strategy, run.gaussians, run.gaussians.storage
    if run.camera_steps:
        run.camera_steps.place()  # now that parts have measured where cameras were
    if storage:
        storage.limit_for(-(-strategy.max_gaussians // run.group.size), run.scene)
    dense = type(gaussians.optimizer) is GaussianAdam and FusedAdam.takes(gaussians)
    if not dense or strategy.queues or any(strategy.penalty) or not run.is_standard:
        return  # a step concerns rows that its view does not see
    spills = run.group.any_rank(storage is not None and storage.limit > 0)
    if spills or saves_time(run.scene, run.device):
        run.sleeping = Sleeping(gaussians)
        if asleep is not None:
            run.sleeping.restore(asleep)
