"""Scores, numbers and records of a training: what a user reads while it runs, and after it."""

import math
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from gaussian_renderer import render
from gaussian_renderer.scored_views import ScoredViews, beside_test, shown_as_trained
from scene import Scene
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from splatting.evaluation.error_curve import whole_sets
from splatting.evaluation.what_to_try import BUDGET, CAP, PLANNED, STRATEGY, what_to_try
from splatting.host.clock import wall_seconds
from splatting.host.progress import Bar
from splatting.training.density import default_budget
from splatting.training.iteration import Iteration, Losses
from splatting.training.objective import LossWatch
from splatting.training.output_folder import view_command
from splatting.training.part import Error, Part, overrides
from splatting.training.run import Run
from utils.image_utils import as_float, mean_psnr, mse, pixels_that_count, psnr
from utils.loss_utils import l1_loss

# Without a rate: that of the schedule is not that of iterations.
BY_CLOCK = "{l_bar}{bar}| [{elapsed}<{remaining}{postfix}]"
BAR_INTERVAL = 10  # iterations between updates, at least
BAR_SECONDS = 0.2  # between updates, at least: each reads the losses, and so waits for the GPU


class ProgressBar(Part):
    """Shows running means. At the end of a training it says how long that took."""

    reads_model = False

    def __init__(self, run: Run) -> None:
        self._run = run
        self._terms = {name: LossWatch() for part in run.parts for name in part.shown}
        titles = {title: self._terms[name] for part in run.parts for name, title in part.shown.items()}
        self._shown = {"Loss": run.losses} | titles
        self._updated, self._done = -math.inf, run.first_iteration
        first = run.schedule.schedule_step(run.first_iteration)
        form = {"bar_format": BY_CLOCK} if run.schedule.by_clock else {}
        self._bar = Bar(initial=first, total=run.schedule.length, desc="Training progress", dynamic_ncols=True, **form)

    def due(self, step: Iteration) -> bool:
        shown = step.iteration % BAR_INTERVAL == 0 and time.monotonic() - self._updated >= BAR_SECONDS
        return step.last or shown

    def measured(self, step: Iteration, losses: Losses) -> None:
        for name in self._terms.keys() & losses.terms.keys():
            self._terms[name].add(step.iteration, losses.terms[name])
        if not step.due:
            return
        for loss in self._shown.values():
            loss.read()
        means = {name: f"{loss.mean:.7f}" for name, loss in self._shown.items()}
        if step.span.stop - 1 != step.iteration:  # the bar counts iterations of the schedule
            means["Iterations"] = f"{step.iteration:,}"
        # As text: tqdm would round the number to three digits.
        self._bar.set_postfix(means, Gaussians=f"{self._run.gaussians.gaussian_count:,}", refresh=False)
        self._bar.update(step.span.stop - 1 - self._bar.n)
        self._updated, self._done = time.monotonic(), step.iteration

    def ended(self, error: Error) -> None:
        self._bar.close()
        if error is not None:
            return
        run, seconds = self._run, self._run.clock.seconds
        if not run.schedule.by_clock:
            before = f", {run.log.seconds_before + seconds:.1f} s with those before" if run.first_iteration else ""
            print(f"{_iterations(self._done - run.first_iteration)} in {seconds:.1f} s{before}")
            return
        # With those before a resume, as the budget.
        seconds, whole = run.log.seconds_before + seconds, run.log.wall_seconds_before + wall_seconds()
        budget = f"budget {run.schedule.seconds:g} s, {whole:.1f} s with start, scores and saves"
        run.log.tell(f"{_iterations(self._done)} in {seconds:.1f} s ({budget})")


def _iterations(count: int) -> str:
    return f"{count:,} iteration{'s' if count != 1 else ''}"


LOG_INTERVAL = 10  # iterations between TensorBoard's losses: reading one waits for the GPU
SHOWN = 5  # views of a set whose images TensorBoard gets


class Report(Part):
    """Scores in testing iterations. writer: TensorBoard's, or None. report: `training_report` or what replaces it."""

    def __init__(self, run: Run, writer: Any | None, report: Callable[..., dict[str, float]]) -> None:
        self._run = run
        self._writer = writer
        self._report = report
        self._later: list[tuple[Iteration, Losses, float]] = []

    def due(self, step: Iteration) -> bool:
        return self._report is not training_report or step.takes(self._run.launch.test_iterations)

    def measured(self, step: Iteration, losses: Losses) -> None:
        seconds = self._run.clock.seconds - step.started
        if step.due or (self._writer and step.iteration % LOG_INTERVAL == 0):
            self._later.append((step, losses, seconds))
        if step.due:
            with self._run.clock.paused("scoring"):
                if step.takes(self._run.launch.test_iterations):
                    self._run.scene.prefetch(self._run.scene.getTestCameras())
                for one in self._read():
                    self._tell(*one)

    def _read(self) -> list[tuple[Iteration, Tensor, Tensor, float]]:
        """Take what is kept, its L1 and total losses on the host: one wait for a GPU instead of two for each."""
        kept, self._later = self._later, []
        values = torch.stack([loss.detach() for _, losses, _ in kept for loss in (losses.l1, losses.total)]).cpu()
        pairs = values.view(-1, 2)
        return [(step, l1, total, seconds) for (step, _, seconds), (l1, total) in zip(kept, pairs, strict=True)]

    def _tell(self, step: Iteration, l1: Tensor, total: Tensor, seconds: float) -> None:
        run = self._run
        tested = [step.iteration if t in step.span else -1 for t in run.launch.test_iterations]
        scores = self._report(
            self._writer, step.iteration, l1, total, l1_loss, seconds, tested,
            run.scene, render, (run.pipe, run.background), run.scene.halves,
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
        if not self._run.density.grows_to:
            budget = default_budget(self._run.scene.getTrainCameras())
            options |= {CAP: opt.max_num_splats} if opt.max_num_splats else {BUDGET: budget}
        log.note(**options)
        log.keep(*self._run.warnings)
        log.advise(*what_to_try(self._run.rows, log.records))


class Summary(Part):
    """Says at the end what the model is worth, and how to look at it."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._psnr: float | None = None
        self._iteration = run.first_iteration

    def measured(self, step: Iteration, losses: Losses) -> None:
        self._iteration = step.iteration
        if step.last:
            saved = self._run.final_iteration or step.iteration
            scored = [row["test_psnr"] for row in whole_sets(self._run.rows) if row["iteration"] == saved]
            self._psnr = scored[0] if scored else None

    def ended(self, error: Error) -> None:
        if error is not None:
            return
        run = self._run
        scored = "" if self._psnr is None else f"Test PSNR {self._psnr:.2f} dB (as metrics.py). "
        print(f"{scored}Look at the model: {view_command(run.scene.model_path, self._iteration)}")


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
    Returns `<set>_l1` and `<set>_psnr` (dB, mean over views and channels) of the sets scored, `beside_test` included.
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

    def draw(camera: Camera, gaussians: GaussianModel) -> Tensor:
        exposed = {"use_trained_exp": True} if shown_as_trained(camera, gaussians) else {}
        return renderFunc(camera, gaussians, *renderArgs, **options | exposed)["render"]

    views = ScoredViews(*renderArgs[:2], train_test_exp, draw)
    train, test = scene.getTrainCameras(), scene.getTestCameras()
    sets = {"test": (views, test)}
    for name, (how, cameras) in beside_test(scene, *renderArgs[:2]).items():
        if how and how.halves:  # what they compare with
            sets["test_right_halves"] = ScoredViews(*renderArgs[:2], True, draw), cameras
        sets[f"test_{name}"] = how or views, cameras
    sets |= {"train": (views, [train[i % len(train)] for i in range(5, 30, 5)])}
    scores = {}
    for name, (scored, cameras) in sets.items():

        def show(camera: Camera, what: str, image: Tensor, name: str = name) -> None:
            if tb_writer:
                tb_writer.add_image(f"{name}_view_{camera.image_name}/{what}", image, global_step=iteration)

        if means := _means(scored, scene, cameras, l1_loss, show, iteration == testing_iterations[0]):
            line = f"[ITER {iteration}] Evaluating {name}: L1 {means['l1']}"
            if "psnr" in means:
                line += f" PSNR {means['psnr']} (mean of the channels'; {means.pop('whole'):.3f} as metrics.py)"
            tqdm.write(line, file=sys.stdout)
            for kind, value in means.items() if tb_writer else ():
                tb_writer.add_scalar(f"{name}/loss_viewpoint - {kind.replace('l1', 'l1_loss')}", value, iteration)
            scores |= {f"{name}_{kind}": value for kind, value in means.items()}
    if tb_writer:
        tb_writer.add_histogram("scene/opacity_histogram", scene.gaussians.get_opacity, iteration)
        tb_writer.add_scalar("total_points", len(scene.gaussians), iteration)
    return scores


@torch.no_grad()
def _means(
    views: ScoredViews,
    scene: Scene,
    cameras: Sequence[Camera],
    l1_loss: Callable[[Tensor, Tensor], Tensor],
    show: Callable[[Camera, str, Tensor], None],
    photos: bool,
) -> dict[str, float]:
    """`l1`, `psnr` by channels and `whole`, by one error over them, the means over the views with a pixel that counts.

    PSNRs of equal images or channels are left out, and so is what no view has. show: gets the renders of the first
    views, and with `photos` their photos.
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


class Records(Part):
    """Writes what other observers have put into the step's record, once all of it is there.

    What parts add is also recorded at points of the curve.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self._seconds = 0.0

    def measured(self, step: Iteration, losses: Losses) -> None:
        run = self._run
        if step.record is None and step.scored_at is None:
            return
        added = {name: number for add in overrides(run.parts, "records") for name, number in add().items()}
        if step.record is None and not added:
            return
        self._seconds = seconds = run.clock.seconds if step.scored_at is None else step.scored_at
        with run.clock.paused("saving"):
            values = (step.record or {}) | added
            run.log.add(step.iteration, seconds, gaussians=run.gaussians.gaussian_count, loss=run.losses.mean, **values)

    def ended(self, error: Error) -> None:
        """Note the seconds of this process: up to its first iteration, of training, of scoring and of saving."""
        if error is not None:
            return
        first, spent = self._run.first_done, self._run.clock.spent
        parts = {"training": self._seconds, "scoring": 0.0, "saving": 0.0} | spent
        self._run.log.note(
            first_iteration_seconds=None if first is None else round(first, 3),
            **{f"{part}_seconds": round(seconds, 3) for part, seconds in parts.items()},
        )
