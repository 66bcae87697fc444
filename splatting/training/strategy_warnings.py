"""Warnings on what the chosen strategy cannot reach, on a full disk, and on processes that do not help."""

import argparse
from collections.abc import Iterator
from typing import TYPE_CHECKING

from scene.gaussians import density_rules as rules
from splatting.host.listing import some
from splatting.registry import part_class, strategies, tools
from splatting.training.density import DensityControl
from splatting.training.memory_estimate import expected_count
from splatting.training.save import little_space
from splatting.training.schedule import USUAL

if TYPE_CHECKING:
    from splatting.training.run import Run

# Milliseconds of a step at 1600x1060 on an H100: of any, and of a million Gaussians (docs/results/several_gpus.md).
STEP_ALONE, STEP_SHARED = (0.9, 1.25), (2.8, 0.87)


def warnings_of(run: "Run", given: argparse.Namespace) -> Iterator[str]:
    """Warnings before a run (splatting/training/run.py). given: the optimisation options as they were given."""
    density, opt, count, done = run.density, run.opt, run.gaussians.gaussian_count, run.first_iteration
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


def faster_alone(ranks: int, on_gpu: bool, count: int) -> str | None:
    """What to say if one GPU would train `count` Gaussians, as many as there may be, faster than several do."""
    alone, shared = (base + each * count / 1e6 for base, each in (STEP_ALONE, STEP_SHARED))
    if ranks == 1 or not on_gpu or shared < alone:
        return None
    return (
        f"one GPU is faster here: a step with {count:,} Gaussians takes about {alone:.1f} ms on one GPU and "
        f"{shared:.1f} ms on two; start train.py without torchrun, unless they do not fit on one"
    )


def without_effect(opt: argparse.Namespace, strategy: str) -> str | None:
    """What to say of given options that belong to another strategy."""
    others = [option for name in strategies() if name != strategy for option in part_class(name).options.optimisation]
    given = [f"--{option.name}" for option in others if getattr(opt, option.name) != option.default]
    return f"--strategy {strategy} ignores {some(given)}" if given else None


def late_reset(density: DensityControl, opt: argparse.Namespace, done: int) -> str | None:
    """What to say if a strategy resets opacities so late that the model cannot recover.

    done: iterations before this run, which may have been the reset. A run with a time budget leaves such resets out.
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
    return (
        f"opacities are reset in iteration {due[-1]}, and the remaining {schedule.ends - due[-1]} iterations are too "
        f"few to recover; {remedy}"
    )


def another_number(density: DensityControl, opt: argparse.Namespace, count: int, first: int) -> str | None:
    """What to say if a strategy cannot reach its number of Gaussians in time.

    count: of Gaussians, now; first: the next iteration. Not known of a run with a time budget.
    """
    schedule, aim, strategy = density.schedule, density.max_gaussians, part_class(opt.strategy)
    if schedule.paced or schedule.schedule_step(first) >= density.ends > 0:
        return None  # what is repeated or resumed has no say in it any more
    ending, start = strategy.until[0], f"--densify_from_iter {opt.densify_from_iter} is not before"
    if 0 < density.ends <= opt.densify_from_iter < schedule.length:
        return f"{start} --{ending} {density.ends}, so no Gaussians are added; lower --densify_from_iter"
    reached = density.projected_count(count, first, schedule.ends)
    too_many, too_late = 0 < opt.max_num_splats < count, opt.densify_from_iter >= schedule.length
    remover = next((name for name in strategies() if part_class(name).removes), None)
    if not density.grows_to:
        remedy = f"; --strategy {remover} removes the surplus" if remover and not too_late else ""
        adds = f"{opt.strategy} adds none, and removes only faint ones"
        return f"{_start_of(count, opt)}; {adds}{remedy}" if too_many else None
    if reached == aim or ((reached > aim or density.default_is_limit) and not opt.max_num_splats):
        return None
    done = schedule.schedule_step(first) - 1
    # Half of what is left suits rules that need the rest to settle, as those that end late by default do not.
    ends = f"--{ending} {done + (schedule.length - done) // 2}" if strategy.until[1] == 1 / 2 else ""
    scaled = None
    if not done and opt.densify_from_iter < density.ends < USUAL:
        scaled = next((remedy(schedule.length) for remedy in tools("for_few_iterations")), None)
    if too_late:
        window = f"--densify_from_iter {done + (schedule.length - done) // 20} {ends}".rstrip()
        why = f"{start} the end; give {scaled or window}"
        if too_many and strategy.removes:
            return f"{_start_of(count, opt)}; only faint ones are removed, as {why}"
    elif too_many and not strategy.removes:
        why = f"it removes none; --strategy {remover} does"
    elif ends and schedule.length < density.ends:
        why = f"--{ending} {density.ends} is not before the end; give {scaled or ends}"
    else:
        why = density.too_slow()
    return f"--strategy {opt.strategy} will reach {reached:,} Gaussians, not {aim:,}, as {why}"


def _start_of(count: int, opt: argparse.Namespace) -> str:
    return f"training starts with {count:,} Gaussians, more than --max_num_splats {opt.max_num_splats}"
