"""Train a Gaussian model: photos with cameras and sparse points in, point_cloud.ply out.

python train.py -s SCENE -m OUT --eval
"""

import argparse
import os
import sys
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import utils.host.openmp  # noqa: F401  isort: skip  (before torch)
import torch
from torch import Tensor
from tqdm import tqdm

from arguments import ModelParams, OptimizationParams, OptionParser, PipelineParams, write_cfg_args, write_model_json
from gaussian_renderer import render
from records.curve_peak import schedules_follow_length
from records.training_log import Stopwatch
from scene import Scene
from scene.gaussian_model import GaussianModel
from scene.gaussians import density as adc
from scene.gaussians.checkpoint import load_checkpoint, save_checkpoint
from training.checks import check_exposures, check_scene, warn_of_late_reset
from training.history import check_folder, continue_records, report_changes
from training.left_out import lines
from training.memory_estimate import announce_memory
from training.observers.curve import scene_curve
from training.observers.divergence import DivergenceWatch
from training.observers.last_save import save_last
from training.observers.losses import LossWatch
from training.observers.masks import MaskWatch
from training.observers.memory import MemoryGuard
from training.observers.report import training_report
from training.view_order import ViewOrder
from utils.exact.counter_rng import Stream, uniform
from utils.general_utils import get_expon_lr_func, safe_state
from utils.host.interrupt import DeferredInterrupt
from utils.loss_utils import inverse_depth_loss, l1_loss, photometric_loss
from utils.system_utils import UserError, compute_device, mkdir_p, run_cli, saved_iterations

try:
    from torch.utils.tensorboard import SummaryWriter
except ImportError:
    SummaryWriter = None

SH_INTERVAL = 1000  # iterations between raises of the active SH degree
BAR_INTERVAL = 10  # iterations between looks at the losses, and updates of the progress bar


def training(
    dataset: argparse.Namespace,
    opt: argparse.Namespace,
    pipe: argparse.Namespace,
    testing_iterations: Sequence[int],
    saving_iterations: Sequence[int],
    checkpoint_iterations: Sequence[int],
    checkpoint: str | None,
    debug_from: int = -1,
    record_curve: bool = True,
) -> None:
    """Train from the options of the three groups; write model, checkpoints and log to dataset.model_path.

    testing_iterations, saving_iterations, checkpoint_iterations: when to score, save the PLY, save a checkpoint.
    checkpoint: a chkpntN.pth to go on from, or None. debug_from: switch pipe.debug on after this iteration.
    record_curve: with test views, write error_vs_time.csv as training goes, and draw it.
    """
    dataset.model_path = dataset.model_path or _new_output_folder()
    print(f"Optimizing {dataset.model_path}")
    device = compute_device()
    capture, first_iteration = load_checkpoint(checkpoint, device) if checkpoint else (None, 0)
    if first_iteration >= opt.iterations:
        raise UserError(
            f"{checkpoint} is at iteration {first_iteration}, so --iterations {opt.iterations} leaves nothing to do; "
            "--iterations counts from the start of the first run"
        )
    warn_of_late_reset(opt, dataset.white_background)
    gaussians = GaussianModel(dataset.sh_degree, opt.optimizer_type)
    scene = Scene(dataset, gaussians, shuffle=False, start=False)
    check_scene(scene.info)
    if capture is None:
        scene.create_gaussians()
        gaussians.training_setup(opt)
    else:
        gaussians.start_exposures(scene.info.train_cameras)
        gaussians.restore(capture, opt)
        check_exposures(gaussians, dataset.train_test_exp, checkpoint)
        capture = None  # so that densification can free what it replaces
    views = ViewOrder(scene.getTrainCameras(), opt.seed)
    masks = MaskWatch(scene.getTrainCameras())
    saves = [iteration for iteration in saving_iterations if iteration <= opt.iterations]
    check_folder(dataset.model_path, dataset.source_path, saves, checkpoint, first_iteration)
    kept = {"antialiasing": pipe.antialiasing, "optimizer_type": opt.optimizer_type, "seed": opt.seed}
    if checkpoint:
        report_changes(checkpoint, argparse.Namespace(**vars(dataset), **kept))
    # After all that bad input can stop, or a slip of the keyboard would overwrite the files of a finished model.
    tb_writer = prepare_output_and_logger(dataset, **kept, world_offset=gaussians.world_offset)
    if not checkpoint or not (Path(scene.model_path) / "cameras.json").exists():
        scene.write_inputs()

    announce_memory(scene, gaussians, opt.max_num_splats)
    fixed_background = torch.full((3,), 1.0 if dataset.white_background else 0.0, device=device)
    log, rows = continue_records(scene.model_path, checkpoint, first_iteration)
    losses = LossWatch(log.loss)
    watch = DivergenceWatch(gaussians, losses, scene.model_path, first_iteration, lambda t: views[t].image_name)
    depth_weight = get_expon_lr_func(opt.depth_l1_weight_init, opt.depth_l1_weight_final, max_steps=opt.iterations)
    depth_losses = LossWatch()
    shown = {"Loss": losses} | ({"Depth Loss": depth_losses} if dataset.depths else {})
    # Where something is written: all losses up to there must have been looked at.
    stops = {opt.iterations, *testing_iterations, *saving_iterations, *checkpoint_iterations}
    curve = left_out = None
    if record_curve:
        curve = scene_curve(
            scene, rows, log, opt.iterations, testing_iterations, pipe, fixed_background, dataset.train_test_exp
        )
    clock = Stopwatch()
    bar = tqdm(initial=first_iteration, total=opt.iterations, desc="Training progress", dynamic_ncols=True)
    guard = MemoryGuard(gaussians, scene.model_path, first_iteration)
    # A thread for each device's backward would have to be woken in every iteration.
    one_thread = torch.autograd.set_multithreading_enabled(False)
    with bar, DeferredInterrupt() as interrupt, guard, one_thread:
        for iteration in range(first_iteration + 1, opt.iterations + 1):
            started = clock.seconds
            gaussians.update_learning_rate(iteration)
            if iteration % SH_INTERVAL == 0:
                gaussians.oneupSHdegree()
            camera = views[iteration]
            guard.working(camera)
            if iteration - 1 == debug_from:
                pipe.debug = True
            scene.prefetch(views.coming(iteration, min(scene.images.ahead, opt.iterations - iteration + 1)))
            background = _random_background(opt.seed, iteration, device) if opt.random_background else fixed_background

            weight = depth_weight(iteration) if camera.depth_reliable else 0.0
            package = render(
                camera, gaussians, pipe, background,
                use_trained_exp=dataset.train_test_exp, want_depth=weight > 0, want_visibility=False, clamp=False,
            )  # fmt: skip
            target, mask = camera.ground_truth(background)
            masks.add(camera, mask)
            loss, l1 = photometric_loss(package["render"], target, opt.lambda_dssim, mask, camera.columns)
            if weight > 0:
                depth_loss = weight * inverse_depth_loss(package["depth"], camera.invdepthmap, camera.columns, mask)
                depth_losses.add(iteration, depth_loss)
                loss = loss + depth_loss
            loss.backward()

            watch.note(iteration, loss)
            curve_due = curve is not None and curve.due(iteration, clock.seconds)
            todo = adc.actions(iteration, opt, dataset.white_background)
            changing = todo.densify or todo.reset_opacity
            if iteration % BAR_INTERVAL == 0 or iteration in stops or curve_due or changing:
                watch.look(iteration)
                _show(bar, iteration, shown, len(gaussians))
                masks.look(last=iteration == opt.iterations)
            seconds = clock.seconds
            with clock.paused():
                if curve_due:
                    curve.add(iteration, seconds, len(gaussians))
                scores = training_report(
                    tb_writer, iteration, l1, loss, l1_loss, seconds - started, testing_iterations, scene, render,
                    (pipe, fixed_background), dataset.train_test_exp,
                )  # fmt: skip
                saving = iteration in saving_iterations
                if saving:
                    gaussians.check_finite(iteration)
                    tqdm.write(f"[ITER {iteration}] Saving Gaussians", file=sys.stdout)
                    if iteration == opt.iterations:
                        scored = curve is not None or iteration in testing_iterations
                        left_out = save_last(scene, dataset, opt, pipe, fixed_background, scored)
                        scores |= {"gaussians_left_out": left_out.unseen}
                    else:
                        scene.save(iteration)
                if saving or scores:
                    log.add(iteration, seconds, gaussians=len(gaussians), loss=losses.mean, **scores)

            guard.changing()
            _control_density(gaussians, package, iteration, todo, opt, scene.cameras_extent)
            if iteration < opt.iterations:
                gaussians.step(package["radii"])
            guard.reached(iteration)
            stop = interrupt.requested  # once: a signal may come at any moment
            if iteration in checkpoint_iterations or stop:
                watch.look(iteration, stepped=iteration < opt.iterations)
                seconds = clock.seconds
                with clock.paused():
                    path = _save_checkpoint(gaussians, scene.model_path, iteration)
                    log.add(iteration, seconds, gaussians=len(gaussians), loss=losses.mean)
            if stop:
                tqdm.write(f"go on with --start_checkpoint {path}", file=sys.stderr)
                raise stop
    if tb_writer:
        tb_writer.close()
    watch.finish()
    print(f"Trained {opt.iterations - first_iteration} iterations in {clock.seconds:.1f} s, without tests and saving")
    if curve is not None:
        saved = {*saving_iterations} & {*saved_iterations(Path(scene.model_path) / "point_cloud")}
        follows_length = schedules_follow_length(bool(dataset.depths), dataset.train_test_exp)
        curve.finish(seconds, saved, opt.position_lr_max_steps, follows_length)
    if left_out is not None:
        print("\n".join(lines(left_out)))


def _random_background(seed: int, iteration: int, device: torch.device) -> Tensor:
    return uniform(seed, Stream.BACKGROUND, iteration, torch.zeros(1, dtype=torch.int64))[0, :3].to(device)


def _show(bar: tqdm, iteration: int, losses: dict[str, LossWatch], count: int) -> None:
    for loss in losses.values():
        loss.read()
    means = {name: f"{loss.mean:.7f}" for name, loss in losses.items()}
    bar.set_postfix(means, Gaussians=count, refresh=False)
    bar.update(iteration - bar.n)


def _save_checkpoint(gaussians: GaussianModel, model_path: str, iteration: int) -> Path:
    gaussians.check_finite(iteration)
    tqdm.write(f"[ITER {iteration}] Saving Checkpoint", file=sys.stdout)
    path = Path(model_path) / f"chkpnt{iteration}.pth"
    save_checkpoint(path, gaussians.capture(), iteration)
    return path


def _control_density(
    gaussians: GaussianModel,
    package: dict[str, Tensor],
    iteration: int,
    todo: adc.Actions,
    opt: argparse.Namespace,
    extent: float,
) -> None:
    """Statistics of this view, and in due time clones, splits, pruning and the reset of opacities."""
    if todo.observe:
        gaussians.observe(package["viewspace_points"], package["radii"])
    if todo.densify:
        gaussians.densify_and_prune(
            opt.densify_grad_threshold,
            adc.MIN_OPACITY,
            extent,
            adc.MAX_SCREEN_SIZE if todo.limit_size else None,
            seed=opt.seed,
            iteration=iteration,
            max_splats=opt.max_num_splats,
        )
        if len(gaussians) == 0:
            raise UserError(
                f"no Gaussian was left after the densification of iteration {iteration}: the views do not agree "
                "with the points, or show nothing but the background; check the scene, or raise "
                "--opacity_reset_interval"
            )
    if todo.reset_opacity:
        gaussians.reset_opacity()


def _new_output_folder() -> str:
    name = os.environ.get("OAR_JOB_ID") or str(uuid.uuid4())
    return os.path.join("./output/", name[:10])


def prepare_output_and_logger(args: argparse.Namespace, **kept: Any) -> Any | None:
    """Make the output folder, args.model_path, with cfg_args and model.json (kept: as write_model_json takes it).

    Returns a TensorBoard writer, or None where TensorBoard is not installed.
    """
    print(f"Output folder: {args.model_path}")
    mkdir_p(args.model_path)
    write_cfg_args(args.model_path, args)
    write_model_json(args.model_path, args, **kept)
    if SummaryWriter is None:
        print("TensorBoard is not installed: no event file")
        return None
    return SummaryWriter(args.model_path)


def _parser() -> tuple[argparse.ArgumentParser, ModelParams, OptimizationParams, PipelineParams]:
    parser = OptionParser(description="Train a Gaussian model from photos with known cameras.")
    groups = ModelParams(parser), OptimizationParams(parser), PipelineParams(parser)
    add = parser.add_argument
    add("--ip", type=str, default="127.0.0.1", help="address of the viewer (no viewer in this version; no effect)")
    add("--port", type=int, default=6009, help="port of the viewer (no effect)")
    add("--disable_viewer", action="store_true", help="open no port for the viewer (none is opened anyway)")
    add("--debug_from", type=int, default=-1, metavar="N", help="switch --debug on after iteration N (default: never)")
    add("--detect_anomaly", action="store_true", help="let autograd name the operation that made a NaN; slow")
    listed = {"type": int, "nargs": "+", "metavar": "N"}
    add("--test_iterations", **listed, default=[7_000, 30_000],
        help="iterations that score the test views, -1: none (default: 7000 30000, reference)")  # fmt: skip
    add("--save_iterations", **listed, default=[7_000, 30_000],
        help="iterations that save the model besides the last, -1: none (default: 7000 30000, reference)")  # fmt: skip
    add("--checkpoint_iterations", **listed, default=[], help="iterations that save a checkpoint (default: none)")
    add("--start_checkpoint", type=str, default=None, metavar="FILE", help="chkpntN.pth to go on from (default: none)")
    add("--no_curve", action="store_true",
        help="no error_vs_time.csv and .png, which cost up to 5 %% of the time, more in short runs (default: with "
        "--eval)")  # fmt: skip
    add("--quiet", action="store_true", help="print nothing but the progress bar and errors")
    return parser, *groups


def parse(argv: Sequence[str] | None = None) -> tuple[argparse.Namespace, ...]:
    """The command line as a whole, and its model, optimisation and pipeline options.

    UserError for a value that cannot be meant; argparse ends the program at words that it does not know.
    """
    parser, *groups = _parser()
    args = parser.parse_args(argv)
    options = [group.extract(args) for group in groups]
    for name in ("test_iterations", "save_iterations", "checkpoint_iterations"):
        wrong = [t for t in getattr(args, name) if t < 1 and t != -1]
        if wrong:
            raise UserError(f"--{name} counts from 1, or is -1 for none, got {wrong[0]}")
    return args, *options


def main(argv: Sequence[str] | None = None) -> None:
    """Train as the command line says."""
    args, dataset, opt, pipe = parse(argv)
    safe_state(args.quiet, opt.seed)
    torch.autograd.set_detect_anomaly(args.detect_anomaly)
    training(
        dataset,
        opt,
        pipe,
        args.test_iterations,
        [*args.save_iterations, opt.iterations],
        args.checkpoint_iterations,
        args.start_checkpoint,
        args.debug_from,
        not args.no_curve,
    )
    print("Training complete.")


if __name__ == "__main__":
    run_cli(main)
