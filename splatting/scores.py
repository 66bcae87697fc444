"""Scores in testing iterations: the training report of the reference, and the observer that calls it."""

import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from tqdm import tqdm

from gaussian_renderer import render
from gaussian_renderer.scored_views import ScoredViews, extra_test_views, has_trained_exposure
from scene import Scene
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from splatting.events import Events
from splatting.iteration import Iteration, Losses
from splatting.part import Part
from utils.image_utils import as_float, mean_psnr, mse, pixels_that_count, psnr
from utils.loss_utils import l1_loss

if TYPE_CHECKING:
    from splatting.run import Run

SHOWN = 5  # views of a set whose images a writer gets


class Scores(Part):
    """Calls the run's report: `training_report` in testing iterations, any other report in all iterations."""

    def __init__(self, run: "Run") -> None:
        self._run = run
        self._planned = run.launch.test_iterations

    def due(self, at: Iteration) -> bool:
        return self._run.report is not training_report or at.takes(self._planned)

    def measured(self, at: Iteration, losses: Losses) -> None:
        """Call the run's report, and put the scores that it returns into the iteration's record."""
        if not self.due(at):
            return
        run, seconds = self._run, self._run.clock.seconds - at.started
        with run.clock.paused("scoring"):
            if at.takes(self._planned):
                run.scene.prefetch(run.scene.getTestCameras())
            l1, total = torch.stack((losses.l1, losses.total)).detach().cpu()
            tested = [at.iteration if t in at.span else -1 for t in self._planned]
            scores = run.report(
                run.writer, at.iteration, l1, total, l1_loss, seconds, tested,
                run.scene, render, (run.pipe, run.background), run.scene.halves,
            )  # fmt: skip
        if scores:
            at.record = (at.record or {}) | scores


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
    """Score and print the test views and five training views, in testing iterations.

    Return `<set>_l1` and `<set>_psnr` (dB, mean over views and channels) of the sets, `extra_test_views` included.
    tb_writer: SummaryWriter of TensorBoard for scores, images and every tenth iteration's losses, or None.
    elapsed: seconds of this iteration.
    renderArgs: arguments of renderFunc after camera and model, (pipe, background) or more.
    train_test_exp: render with exposures, and score right halves only; a sixth of renderArgs says so, too.
    """
    told = [Events(tb_writer, iteration)] if tb_writer else []
    for events in told:
        events.losses(l1, loss, elapsed)
    if iteration not in testing_iterations:
        return {}
    options = {"use_trained_exp": True} if train_test_exp and len(renderArgs) < 6 else {}
    if renderFunc is render:
        options["want_depth"] = False  # our own addition: only images are scored

    def draw(camera: Camera, gaussians: GaussianModel) -> Tensor:
        exposed = {"use_trained_exp": True} if has_trained_exposure(camera, gaussians) else {}
        return renderFunc(camera, gaussians, *renderArgs, **options | exposed)["render"]

    views = ScoredViews(*renderArgs[:2], train_test_exp, draw)
    train, test = scene.getTrainCameras(), scene.getTestCameras()
    sets = {"test": (views, test)}
    for name, (how, cameras) in extra_test_views(scene, *renderArgs[:2]).items():
        if how and how.halves:  # what they compare with
            sets["test_right_halves"] = ScoredViews(*renderArgs[:2], True, draw), cameras
        sets[f"test_{name}"] = how or views, cameras
    sets |= {"train": (views, [train[i % len(train)] for i in range(5, 30, 5)])}
    scores = {}
    for name, (scored, cameras) in sets.items():

        def show(camera: Camera, what: str, image: Tensor, name: str = name) -> None:
            for events in told:
                events.image(name, camera, what, image)

        if means := _mean_scores(scored, scene, cameras, l1_loss, show, iteration == testing_iterations[0]):
            line = f"[ITER {iteration}] Evaluating {name}: L1 {means['l1']:.5f}"
            if "psnr" in means:
                line += f" PSNR {means['psnr']:.3f} (mean of the channels'; {means.pop('whole'):.3f} as metrics.py)"
            tqdm.write(line, file=sys.stdout)
            for events in told:
                events.scores(name, means)
            scores |= {f"{name}_{kind}": value for kind, value in means.items()}
    for events in told:
        events.model(scene.gaussians)
    return scores


@torch.no_grad()
def _mean_scores(
    views: ScoredViews,
    scene: Scene,
    cameras: Sequence[Camera],
    l1_loss: Callable[[Tensor, Tensor], Tensor],
    show: Callable[[Camera, str, Tensor], None],
    photos: bool,
) -> dict[str, float]:
    """Return the means of `l1`, of `psnr` by channels, and of `whole`, the PSNR by one error over all channels.

    Views without a pixel that counts are left out, and so are PSNRs of equal images or channels, and scores that no
    view has.

    show: gets the renders of the first views, and with `photos` their photos.
    """
    scores = []
    for index, camera in enumerate(cameras):
        image, target, mask = views.compared(camera, scene.gaussians)
        if mask is not None and not mask.any():
            continue
        target = as_float(target)
        counted = [pixels_that_count(x, mask) for x in (image, target)]
        of_channels = psnr(*counted).flatten()
        own = of_channels[~of_channels.isinf()]
        whole = -10.0 * mse(*counted).mean().log10()
        scores.append((l1_loss(*counted).item(), own.mean().item() if len(own) else None, whole.item()))
        if index < SHOWN:
            show(camera, "render", image)
            if photos:
                show(camera, "ground_truth", target)
    columns = dict(zip(("l1", "psnr", "whole"), zip(*scores, strict=True), strict=False))
    means = {name: mean_psnr(values) for name, values in columns.items()}
    return {name: value for name, value in means.items() if value is not None}
