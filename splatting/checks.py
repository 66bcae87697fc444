"""Checks around a training: before it, what cannot be trained or reached; after it, whether it overfitted."""

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from arguments.features import FEATURES
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


def check_alone(projection: str, several: bool) -> None:
    """Refuse --projection ray in a training of several processes (UserError)."""
    if several and projection == "ray":
        raise UserError(
            "--projection ray needs a training of one process; leave it out, or start train.py without torchrun"
        )


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
        another_number(density, opt, count, done + 1),
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
    if not (due := [iteration for iteration in last if density.resets(iteration)]):
        return None
    of_white = schedule.schedule_step(due[-1]) % opt.opacity_reset_interval > 0
    remedy = "raise --opacity_reset_interval"
    if of_white:
        remedy = "lower --densify_from_iter, at which a white background resets opacities"
    left = f"the remaining {schedule.ends - due[-1]} iterations are too few to recover"
    return Finding(f"{LATE_RESET} in iteration {due[-1]}, and {left}", remedy)


def another_number(density: Strategy, opt: argparse.Namespace, count: int, first: int) -> Finding | None:
    """Return a warning if a strategy cannot reach its number of Gaussians in time, or None.

    The number that a run with a time budget will reach is not known, so there is no warning either.

    count: present number of Gaussians.
    first: the next iteration.
    """
    schedule, aim = density.schedule, density.max_gaussians
    if schedule.paced or schedule.schedule_step(first) >= density.ends > 0:
        return None  # what is repeated or resumed has no say in it any more
    ending, start = density.until[0], f"--densify_from_iter {opt.densify_from_iter} is not before"
    if 0 < density.ends <= opt.densify_from_iter < schedule.length:
        return Finding(f"{start} --{ending} {density.ends}, so no Gaussians are added", "lower --densify_from_iter")
    reached = density.projected_count(count, first, schedule.ends)
    too_many, too_late = 0 < opt.max_num_splats < count, opt.densify_from_iter >= schedule.length
    remover = next((strategy.name for strategy in strategies() if strategy.removes), None)
    if not density.grows_to:
        remedy = f"--strategy {remover} removes the surplus" if remover and not too_late else ""
        text = f"{_start_of(count, opt)}; {opt.strategy} adds none, and removes only faint ones"
        return Finding(text, remedy) if too_many else None
    if reached == aim or ((reached > aim or density.default_is_limit) and not opt.max_num_splats):
        return None
    done = schedule.schedule_step(first) - 1
    # Half of what is left suits rules that need the rest to settle, as those that end late by default do not.
    ends = f"--{ending} {done + (schedule.length - done) // 2}" if density.until[1] == 1 / 2 else ""
    scaled = None
    if not done and opt.densify_from_iter < density.ends < schedule.usual and hasattr(opt, "schedule"):
        scaled = f"--schedule {schedule.length} in place of --iterations {schedule.length}"
    if too_late:
        window = f"--densify_from_iter {done + (schedule.length - done) // 20} {ends}".rstrip()
        why = f"{start} the end; give {scaled or window}"
        if too_many and density.removes:
            return Finding(_start_of(count, opt), f"only faint ones are removed, as {why}")
    elif too_many and not density.removes:
        why = f"it removes none; --strategy {remover} does"
    elif ends and schedule.length < density.ends:
        why = f"--{ending} {density.ends} is not before the end; give {scaled or ends}"
    else:
        why = density.too_slow()
    return Finding(f"--strategy {opt.strategy} will reach {reached:,} Gaussians, not {aim:,}, as {why}")


def _start_of(count: int, opt: argparse.Namespace) -> str:
    return f"training starts with {count:,} Gaussians, more than --max_num_splats {opt.max_num_splats}"


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
