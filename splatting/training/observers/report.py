"""Scores in testing iterations, the events for TensorBoard, and what to try after the training."""

import sys
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from gaussian_renderer import render
from gaussian_renderer.scored_views import ScoredViews
from scene import Scene
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from splatting.evaluation.what_to_try import BUDGET, CAP, PLANNED, STRATEGY, what_to_try
from splatting.training.objective import Losses
from splatting.training.observer import Error, Observer
from splatting.training.run import Run
from splatting.training.step import Step
from splatting.training.strategies.budget import default_budget
from utils.image_utils import as_float, pixels_that_count, psnr
from utils.loss_utils import l1_loss

LOG_INTERVAL = 10  # iterations between TensorBoard's losses: reading one waits for the GPU
SHOWN = 5  # views of a set whose images TensorBoard gets


class Report(Observer):
    """Scores in testing iterations. writer: TensorBoard's, or None. report: `training_report` or what replaces it."""

    def __init__(self, run: Run, writer: Any | None, report: Callable[..., dict[str, float]]) -> None:
        self._run = run
        self._writer = writer
        self._report = report
        self._later: list[tuple[Step, Losses, float]] = []

    def due(self, step: Step) -> bool:
        return self._report is not training_report or step.takes(self._run.launch.test_iterations)

    def measured(self, step: Step, losses: Losses) -> None:
        seconds = self._run.clock.seconds - step.started
        if step.due or (self._writer and step.iteration % LOG_INTERVAL == 0):
            self._later.append((step, losses, seconds))
        if step.due:
            with self._run.clock.paused("scoring"):
                if step.takes(self._run.launch.test_iterations):
                    self._run.scene.prefetch(self._run.scene.getTestCameras())
                for one in self._read():
                    self._tell(*one)

    def _read(self) -> list[tuple[Step, Tensor, Tensor, float]]:
        """Take what is kept, its L1 and total losses on the host: one wait for a GPU instead of two for each."""
        kept, self._later = self._later, []
        values = torch.stack([loss.detach() for _, losses, _ in kept for loss in (losses.l1, losses.total)]).cpu()
        pairs = values.view(-1, 2)
        return [(step, l1, total, seconds) for (step, _, seconds), (l1, total) in zip(kept, pairs, strict=True)]

    def _tell(self, step: Step, l1: Tensor, total: Tensor, seconds: float) -> None:
        run = self._run
        tested = [step.iteration if t in step.span else -1 for t in run.launch.test_iterations]
        scores = self._report(
            self._writer, step.iteration, l1, total, l1_loss, seconds, tested,
            run.scene, render, (run.pipe, run.background), run.dataset.train_test_exp,
        )  # fmt: skip
        if scores:
            step.record = (step.record or {}) | scores

    def ended(self, error: Error) -> None:
        if self._writer:
            self._writer.close()
        if error is not None:
            return
        log, opt = self._run.log, self._run.opt
        options = {PLANNED: opt.iterations, STRATEGY: opt.strategy}
        if opt.strategy == "adc":  # the others are meant to reach their number
            budget = default_budget(self._run.scene.getTrainCameras())
            options |= {CAP: opt.max_num_splats} if opt.max_num_splats else {BUDGET: budget}
        log.note(**options)
        if sentences := what_to_try(self._run.rows, log.records):
            log.tell(*sentences)


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
    """Log every tenth iteration to TensorBoard; in testing iterations, score and print test and five training views.

    elapsed: seconds of this iteration; renderArgs: what follows camera and model in renderFunc, (pipe, background) or
    more. train_test_exp: render with exposures (a sixth of renderArgs says so, too), and score right halves only.
    Returns `<set>_l1` and `<set>_psnr` (dB, mean over views and channels) of the sets scored, {} otherwise.
    """
    if tb_writer and iteration % LOG_INTERVAL == 0:
        tb_writer.add_scalar("train_loss_patches/l1_loss", l1.item(), iteration)
        tb_writer.add_scalar("train_loss_patches/total_loss", loss.item(), iteration)
        tb_writer.add_scalar("iter_time", elapsed * 1000.0, iteration)
    if iteration not in testing_iterations:
        return {}
    options = {"use_trained_exp": True} if train_test_exp and len(renderArgs) < 6 else {}
    if renderFunc is render:
        options["want_depth"] = False  # our own addition: only images are scored
    views = ScoredViews(
        *renderArgs[:2],
        train_test_exp,
        lambda camera, gaussians: renderFunc(camera, gaussians, *renderArgs, **options)["render"],
    )
    train = scene.getTrainCameras()
    sets = {"test": scene.getTestCameras(), "train": [train[i % len(train)] for i in range(5, 30, 5)]}
    scores = {}
    for name, cameras in sets.items():
        show = _shown_by(tb_writer, name, iteration, iteration == testing_iterations[0])
        if means := _means(views, cameras, scene.gaussians, l1_loss, show):
            l1_mean, psnr_mean = means
            tqdm.write(f"[ITER {iteration}] Evaluating {name}: L1 {l1_mean} PSNR {psnr_mean}", file=sys.stdout)
            if tb_writer:
                tb_writer.add_scalar(f"{name}/loss_viewpoint - l1_loss", l1_mean, iteration)
                tb_writer.add_scalar(f"{name}/loss_viewpoint - psnr", psnr_mean, iteration)
            scores |= {f"{name}_l1": l1_mean, f"{name}_psnr": psnr_mean}
    if tb_writer:
        tb_writer.add_histogram("scene/opacity_histogram", scene.gaussians.get_opacity, iteration)
        tb_writer.add_scalar("total_points", len(scene.gaussians), iteration)
    return scores


@torch.no_grad()
def _means(
    views: ScoredViews,
    cameras: Sequence[Camera],
    gaussians: GaussianModel,
    l1_loss: Callable[[Tensor, Tensor], Tensor],
    show: Callable[[int, Camera, Tensor, Tensor], None],
) -> list[float]:
    """Mean L1, and mean PSNR of the channels, over the views with a pixel that counts; nothing without any."""
    scores = []
    for index, camera in enumerate(cameras):
        image, target, mask = views.compared(camera, gaussians)
        if mask is not None and not mask.any():
            continue
        target = as_float(target)
        counted = [pixels_that_count(x, mask) for x in (image, target)]
        scores.append((l1_loss(*counted).item(), psnr(*counted).mean().item()))
        show(index, camera, image, target)
    return [sum(values) / len(values) for values in zip(*scores, strict=True)]


def _shown_by(writer: Any | None, name: str, iteration: int, first: bool) -> Callable[..., None]:
    """Gives TensorBoard, if there, the render of a set's first views, and at the first testing their photos."""

    def show(index: int, camera: Camera, image: Tensor, target: Tensor) -> None:
        if writer is None or index >= SHOWN:
            return
        tag = f"{name}_view_{camera.image_name}"
        writer.add_image(f"{tag}/render", image, global_step=iteration)
        if first:
            writer.add_image(f"{tag}/ground_truth", target, global_step=iteration)

    return show
