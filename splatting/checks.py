"""Checks around a training: before it, what cannot be trained or reached; after it, whether it overfitted."""

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from arguments.features import FEATURES
from groundwork.applications import application
from groundwork.finding import Finding, Severity
from groundwork.host.listing import some
from scene.checks.conversion import has_undistorted_photos
from scene.gaussians import density_rules as rules
from splatting.part import Strategy
from splatting.records.error_curve import Row, gain_since_peak, peak
from splatting.registry import strategies
from splatting.resources import expected_count, little_space
from utils.system_utils import UserError

STRATEGY = "strategy"  # of the training, in the log's last record
LATE_RESET = "opacities are reset"  # how the text of a late reset begins

# Milliseconds of a step at 1600x1060 on an H100: of any, and of a million Gaussians (docs/results/several_gpus.md).
STEP_ALONE, STEP_SHARED = (0.9, 1.25), (2.8, 0.87)


def check_alone(pipe: argparse.Namespace, launch: argparse.Namespace, several: bool) -> None:
    """Refuse options that need one process in a training of several (UserError)."""
    given = {
        "--projection ray": getattr(pipe, "projection", "ewa") == "ray",
        "--viewer": launch.viewer is not None or launch.paused,
    }
    if several and (option := next((option for option, there in given.items() if there), None)):
        raise UserError(f"{option} needs a training of one process; leave it out, or start train.py without torchrun")


def check_viewer(launch: argparse.Namespace) -> None:
    """Refuse a page that cannot be served (UserError)."""
    if launch.viewer is not None:
        application("viewer", "server").check_port(launch.viewer)
    elif launch.paused:
        raise UserError("--paused needs --viewer, whose page lets the training go on")


def check_native(options: argparse.Namespace) -> None:
    """Warn where --lenses native was given for photos that are undistorted already."""
    if getattr(options, "lenses", "") == "native" and has_undistorted_photos(options.source_path):
        print(
            "warning: --lenses native has no effect, since convert.py undistorted the photos of this scene; to train "
            "on them as they were taken, convert again with --lenses native",
            file=sys.stderr,
        )


def warnings_of(run: Any, given: argparse.Namespace) -> Iterator[Finding]:
    """Yield the warnings before a run (splatting/run.py).

    given: the optimisation options as the user gave them.
    """
    density, opt, count, done = run.strategy, run.opt, run.gaussians.gaussian_count, run.first_iteration
    expected = expected_count(density.max_gaussians, count)
    sure = min(count, density.max_gaussians or count)
    found = (
        little_space(run, sure, expected, done + 1) if run.group.first else None,
        faster_alone(run.group.size, run.device.type == "cuda", expected),
        late_reset(density, opt, done),
        without_effect(given, opt.strategy),
    )
    yield from filter(None, found)


def faster_alone(ranks: int, on_gpu: bool, count: int) -> Finding | None:
    """Return a warning if one GPU would train `count` Gaussians faster than several GPUs do; otherwise None.

    count: the most Gaussians that there may be.
    """
    alone, shared = (base + each * count / 1e6 for base, each in (STEP_ALONE, STEP_SHARED))
    if ranks == 1 or not on_gpu or shared < alone:
        return None
    times = f"{alone:.1f} ms on one GPU and {shared:.1f} ms on two"
    text = f"one GPU is faster here: a step with {count:,} Gaussians takes about {times}"
    return Finding(text, "start train.py without torchrun, unless they do not fit on one")


def without_effect(opt: argparse.Namespace, strategy: str) -> Finding | None:
    """Return a warning about given options that belong to another strategy, or None."""
    others = [option for one in strategies() if one.name != strategy for option in FEATURES[one.name].optimisation]
    given = [f"--{option.name}" for option in others if getattr(opt, option.name) != option.default]
    return Finding(f"--strategy {strategy} ignores {some(given)}") if given else None


def late_reset(density: Strategy, opt: argparse.Namespace, done: int) -> Finding | None:
    """Return a warning if a strategy resets opacities so late that the model cannot recover, or None.

    A run with a time budget leaves such resets out.

    done: iterations before this run, the last of which may have been the reset.
    """
    schedule = density.schedule
    if schedule.paced:
        return None
    last = range(max(done, schedule.ends - rules.RECOVERY) + 1, schedule.ends)
    if not (due := [iteration for iteration in last if density.actions(iteration).reset_opacity]):
        return None
    of_white = schedule.schedule_step(due[-1]) % opt.opacity_reset_interval > 0
    remedy = "raise --opacity_reset_interval"
    if of_white:
        remedy = "lower --densify_from_iter, at which a white background resets opacities"
    left = f"the remaining {schedule.ends - due[-1]} iterations are too few to recover"
    return Finding(f"{LATE_RESET} in iteration {due[-1]}, and {left}", remedy)


def check_overfitting(rows: Sequence[Row], records: Sequence[Mapping[str, Any]]) -> Iterator[Finding]:
    """Find test views whose PSNR fell while that of the training views rose.

    rows: rows of error_vs_time.csv, of which only those that score whole sets count.
    records: records of train_log.json.
    """
    if (gained := gain_since_peak(rows)) is None:
        return
    best, lost = peak(rows)
    half = max(1, int((rows[-1]["gaussians"] or 0) / 2))
    fewer = f" (--max_num_splats {half}, half as many as now)" if half > 1 else ""
    strategy = records[-1].get(STRATEGY, "adc") if records else "adc"
    others = {"adc": "--strategy mcmc or budget with ", "budget": "--strategy mcmc, "}.get(strategy, "")
    seen = f"From iteration {best['iteration']} on only the training photos were fitted (+{gained:.2f} dB), and"
    remedy = f"try {others}fewer Gaussians{fewer}, a lower --sh_degree, or more photos"
    yield Finding(f"{seen} the test views lost {lost:.2f} dB", remedy, Severity.NOTE)
