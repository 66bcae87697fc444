"""Train a Gaussian model: photos with cameras and sparse points in, point_cloud.ply out.

python train.py -s SCENE -m OUT --eval
"""

import argparse
import dataclasses
import math
import os
import sys
import uuid
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import utils.openmp  # noqa: F401  isort: skip  (before torch)
import torch
from torch import Tensor
from tqdm import tqdm

from arguments import (
    ModelParams,
    OptimizationParams,
    OptionParser,
    PipelineParams,
    add_to_model_json,
    write_cfg_args,
    write_model_json,
)
from gaussian_renderer import render
from gaussian_renderer.scored_views import ScoredViews
from gaussian_renderer.trimming import change_on_views, trim
from scene import Scene
from scene import densification as adc
from scene.cameras import Camera
from scene.checkpoint import load_checkpoint, save_checkpoint
from scene.divergence import DivergenceWatch
from scene.gaussian_model import GaussianModel
from scene.mask_watch import MaskWatch
from scene.memory_estimate import announce_memory
from scene.memory_guard import MemoryGuard
from utils.counter_rng import Stream, permutation, uniform
from utils.curve_peak import schedules_follow_length
from utils.curve_recorder import CurveRecorder, evenly_spread
from utils.error_curve import Row, continue_curve
from utils.general_utils import get_expon_lr_func, safe_state
from utils.image_utils import as_float, pixels_that_count, psnr, right_half
from utils.interrupt import DeferredInterrupt
from utils.left_out import LeftOut, lines
from utils.loss_utils import inverse_depth_loss, l1_loss, photometric_loss
from utils.loss_watch import LossWatch
from utils.system_utils import UserError, compute_device, mkdir_p, run_cli, saved_iterations
from utils.training_log import Stopwatch, TrainingLog

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
    _warn_of_late_reset(opt, dataset.white_background)
    gaussians = GaussianModel(dataset.sh_degree, opt.optimizer_type)
    scene = Scene(dataset, gaussians, shuffle=False, write=False)
    gaussians.training_setup(opt)
    if capture is not None:
        gaussians.restore(capture, opt)
        _check_exposures(gaussians, dataset.train_test_exp, checkpoint)
        capture = None  # so that densification can free what it replaces
    views = _ViewOrder(scene.getTrainCameras(), opt.seed)
    masks = MaskWatch(scene.getTrainCameras())
    # After all that bad input can stop, or a slip of the keyboard would overwrite the files of a finished model.
    tb_writer = prepare_output_and_logger(
        dataset, antialiasing=pipe.antialiasing, seed=opt.seed, world_offset=gaussians.world_offset
    )
    if not checkpoint or not (Path(scene.model_path) / "cameras.json").exists():
        scene.write_inputs()

    announce_memory(scene, gaussians, opt.max_num_splats)
    fixed_background = torch.full((3,), 1.0 if dataset.white_background else 0.0, device=device)
    log = TrainingLog(scene.model_path, first_iteration)
    losses = LossWatch(log.loss)
    watch = DivergenceWatch(gaussians, losses, scene.model_path, first_iteration, lambda t: views[t].image_name)
    depth_weight = get_expon_lr_func(opt.depth_l1_weight_init, opt.depth_l1_weight_final, max_steps=opt.iterations)
    depth_losses = LossWatch()
    # Where something is written: all losses up to there must have been looked at.
    stops = {opt.iterations, *testing_iterations, *saving_iterations, *checkpoint_iterations}
    rows = continue_curve(scene.model_path, first_iteration)
    curve = None
    if record_curve and scene.getTestCameras():
        curve = _curve(
            scene, rows, log, opt.iterations, testing_iterations, pipe, fixed_background, dataset.train_test_exp
        )
    left_out = None
    clock = Stopwatch()
    bar = tqdm(initial=first_iteration, total=opt.iterations, desc="Training progress", dynamic_ncols=True)
    guard = MemoryGuard(gaussians, scene.model_path, first_iteration)
    with bar, DeferredInterrupt() as interrupt, guard:
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
                shown = {"Loss": f"{losses.mean:.7f}"}
                if dataset.depths:
                    depth_losses.read()
                    shown["Depth Loss"] = f"{depth_losses.mean:.7f}"
                bar.set_postfix(shown, Gaussians=len(gaussians), refresh=False)
                bar.update(iteration - bar.n)
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
                        left_out = _save_last(scene, dataset, opt, pipe, fixed_background, scored)
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
                    gaussians.check_finite(iteration)
                    tqdm.write(f"[ITER {iteration}] Saving Checkpoint", file=sys.stdout)
                    path = Path(scene.model_path) / f"chkpnt{iteration}.pth"
                    save_checkpoint(path, gaussians.capture(), iteration)
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


def _curve(
    scene: Scene,
    rows: list[Row],
    log: TrainingLog,
    iterations: int,
    testing_iterations: Sequence[int],
    pipe: argparse.Namespace,
    background: Tensor,
    train_test_exp: bool,
) -> CurveRecorder:
    """Recorder of the error of all test views and as many training views."""
    test = scene.getTestCameras()
    trained = [camera for camera in scene.getTrainCameras() if camera.columns is None]  # in whole
    scored = ScoredViews(pipe, background, train_test_exp)
    return CurveRecorder(
        scene.model_path,
        rows,
        log,
        iterations,
        testing_iterations,
        {"test": test, "train": evenly_spread(trained, len(test))},
        lambda camera: scored.image(camera, scene.gaussians),
        scored.target,
        scored.mask,
        background.device,
    )


def _save_last(
    scene: Scene,
    dataset: argparse.Namespace,
    opt: argparse.Namespace,
    pipe: argparse.Namespace,
    background: Tensor,
    scored: bool,
) -> LeftOut:
    """Save the finished model without what it does not need; what that was goes into model.json, too.

    scored: the test pictures are in memory, so that the change in PSNR costs little.
    """
    trained = scene.gaussians
    trained.optimizer.zero_grad(set_to_none=True)  # the last iteration takes no step: room for the trimmed copy
    trimmed = trim(trained, scene.getTrainCameras(), pipe, opt.keep_unseen, opt.prune_sh)
    final, test = trimmed.gaussians, scene.getTestCameras()
    change = {}
    if test and final is not trained:
        views = ScoredViews(pipe, background, dataset.train_test_exp)
        truth = (lambda camera: (views.target(camera), views.mask(camera))) if scored else None
        change = change_on_views(trained, final, test, views.image, truth)
    scene.save(opt.iterations, final)
    write_cfg_args(scene.model_path, argparse.Namespace(**vars(dataset) | {"sh_degree": final.max_sh_degree}))
    kept_pixels, file_pixels = scene.training_pixels()
    left_out = LeftOut(
        gaussians=len(trained),
        unseen=trimmed.unseen,
        keep_unseen=opt.keep_unseen,
        max_sh_degree=trained.max_sh_degree,
        sh_degree=final.max_sh_degree,
        cut_bounds=trimmed.cut_bounds,
        ply_bytes=trained.ply_bytes,
        ply_bytes_saved=trained.ply_bytes - final.ply_bytes,
        seconds=round(trimmed.seconds, 3),
        picture_bytes=3 * kept_pixels,
        picture_bytes_in_files=3 * file_pixels,
        test_change={name: value for name, value in change.items() if math.isfinite(value)},
    )
    add_to_model_json(scene.model_path, left_out=dataclasses.asdict(left_out))
    return left_out


def _check_exposures(gaussians: GaussianModel, train_test_exp: bool, checkpoint: str) -> None:
    """UserError for a checkpoint with exposures that this run would not use; a word on the opposite."""
    if gaussians.exposures.trained and not train_test_exp:
        raise UserError(f"{checkpoint} was trained with --train_test_exp; give that option")
    if train_test_exp and not gaussians.exposures.trained:
        print(f"{checkpoint} has no exposures: all pictures start without a correction")


class _ViewOrder:
    """Training cameras by iteration (from 1): each once per epoch, in an order drawn anew from seed and epoch."""

    def __init__(self, cameras: list[Camera], seed: int) -> None:
        if not cameras:
            raise UserError("the scene has no training views; without --eval all views train")
        self._cameras = cameras
        self._seed = seed
        self._orders: dict[int, list[int]] = {}

    def __getitem__(self, iteration: int) -> Camera:
        epoch, position = divmod(iteration - 1, len(self._cameras))
        if epoch not in self._orders:
            # At most two: looking ahead from the end of one epoch goes to and fro between it and the next.
            order = permutation(self._seed, Stream.VIEW_ORDER, epoch, len(self._cameras))
            self._orders = {epoch: order} | {e: o for e, o in self._orders.items() if e == epoch - 1}
        return self._cameras[self._orders[epoch][position]]

    def coming(self, iteration: int, count: int) -> list[Camera]:
        """The cameras of `count` iterations, this one first; of an epoch's length at most."""
        return [self[t] for t in range(iteration, iteration + min(count, len(self._cameras)))]


def _random_background(seed: int, iteration: int, device: torch.device) -> Tensor:
    return uniform(seed, Stream.BACKGROUND, iteration, torch.zeros(1, dtype=torch.int64))[0, :3].to(device)


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


def _warn_of_late_reset(opt: argparse.Namespace, white_background: bool) -> None:
    last = range(max(1, opt.iterations - 999), opt.iterations)
    late = [t for t in last if adc.actions(t, opt, white_background).reset_opacity]
    if late:
        print(
            f"warning: opacities are reset in iteration {late[-1]}, and {opt.iterations - late[-1]} iterations are few "
            "to recover from that; change --iterations or --opacity_reset_interval"
        )


def _new_output_folder() -> str:
    name = os.environ.get("OAR_JOB_ID") or str(uuid.uuid4())
    return os.path.join("./output/", name[:10])


def prepare_output_and_logger(
    args: argparse.Namespace, *, antialiasing: bool, seed: int, world_offset: Sequence[float] = (0.0, 0.0, 0.0)
) -> Any | None:
    """Make the output folder, args.model_path, with cfg_args and model.json.

    Returns a TensorBoard writer, or None where TensorBoard is not installed.
    """
    print(f"Output folder: {args.model_path}")
    mkdir_p(args.model_path)
    write_cfg_args(args.model_path, args)
    write_model_json(args.model_path, args, antialiasing=antialiasing, seed=seed, world_offset=world_offset)
    if SummaryWriter is None:
        print("TensorBoard is not installed: no event file")
        return None
    return SummaryWriter(args.model_path)


def training_report(
    tb_writer: Any | None,
    iteration: int,
    l1: Tensor,
    loss: Tensor,
    l1_loss: Callable[[Tensor, Tensor], Tensor],
    elapsed: float,
    testing_iterations: Sequence[int],
    scene: Scene,
    renderFunc: Callable[..., dict[str, Tensor]],
    renderArgs: tuple,
    train_test_exp: bool = False,
) -> dict[str, float]:
    """Log every tenth iteration to TensorBoard; in a testing one score test views and five training views, and print.

    elapsed: seconds of this iteration; renderArgs: what follows camera and model in renderFunc, (pipe, background).
    train_test_exp: render with exposures, and score right halves only.
    Returns `<set>_l1` and `<set>_psnr` (dB, mean over views and channels) of the sets scored, {} otherwise.
    """
    if tb_writer and iteration % BAR_INTERVAL == 0:  # not always: reading a loss waits for the GPU
        tb_writer.add_scalar("train_loss_patches/l1_loss", l1.item(), iteration)
        tb_writer.add_scalar("train_loss_patches/total_loss", loss.item(), iteration)
        tb_writer.add_scalar("iter_time", elapsed * 1000.0, iteration)
    if iteration not in testing_iterations:
        return {}
    exposed = {"use_trained_exp": True} if train_test_exp else {}
    train = scene.getTrainCameras()
    sets = {"test": scene.getTestCameras(), "train": [train[i % len(train)] for i in range(5, 30, 5)]}
    scores = {}
    for name, cameras in sets.items():
        if not cameras:
            continue
        differences, ratios = [], []
        for index, camera in enumerate(cameras):
            with torch.no_grad():
                image = renderFunc(camera, scene.gaussians, *renderArgs, **exposed)["render"]
                target = as_float(camera.target(renderArgs[1]))
                mask = camera.mask
                if train_test_exp:
                    image, target, mask = (None if x is None else right_half(x) for x in (image, target, mask))
                if mask is not None and not mask.any():
                    continue
                counted = [pixels_that_count(x, mask) for x in (image, target)]
                differences.append(l1_loss(*counted).item())
                ratios.append(psnr(*counted).mean().item())
            if tb_writer and index < 5:
                tag = f"{name}_view_{camera.image_name}"
                tb_writer.add_image(f"{tag}/render", image, global_step=iteration)
                if iteration == testing_iterations[0]:
                    tb_writer.add_image(f"{tag}/ground_truth", target, global_step=iteration)
        if not ratios:
            continue
        l1_mean, psnr_mean = sum(differences) / len(differences), sum(ratios) / len(ratios)
        tqdm.write(f"[ITER {iteration}] Evaluating {name}: L1 {l1_mean} PSNR {psnr_mean}", file=sys.stdout)
        if tb_writer:
            tb_writer.add_scalar(f"{name}/loss_viewpoint - l1_loss", l1_mean, iteration)
            tb_writer.add_scalar(f"{name}/loss_viewpoint - psnr", psnr_mean, iteration)
        scores |= {f"{name}_l1": l1_mean, f"{name}_psnr": psnr_mean}
    if tb_writer:
        tb_writer.add_histogram("scene/opacity_histogram", scene.gaussians.get_opacity, iteration)
        tb_writer.add_scalar("total_points", len(scene.gaussians), iteration)
    return scores


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
        help="no error_vs_time.csv and .png, which cost up to 5 %% of the time (default: with --eval)")  # fmt: skip
    add("--quiet", action="store_true", help="print nothing but the progress bar and errors")
    return parser, *groups


def main(argv: Sequence[str] | None = None) -> None:
    """The command line."""
    parser, model, optimisation, pipeline = _parser()
    args = parser.parse_args(argv)
    dataset, opt, pipe = model.extract(args), optimisation.extract(args), pipeline.extract(args)
    for name in ("test_iterations", "save_iterations", "checkpoint_iterations"):
        wrong = [t for t in getattr(args, name) if t < 1 and t != -1]
        if wrong:
            raise UserError(f"--{name} counts from 1, or is -1 for none, got {wrong[0]}")
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
