"""A training: before it, what cannot be trained or reached; after it, what its log and its curve suggest to try."""

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from scene.gaussians import density_rules as rules
from splatting.evaluation.error_curve import CLEAR, Row, gain_since_peak, peak, whole_sets
from splatting.findings import Finding, Severity
from splatting.findings.capture import already_undistorted
from splatting.findings.resources import expected_count, little_space
from splatting.host.listing import some
from splatting.registry import part_class, strategies, tools
from utils.system_utils import UserError

if TYPE_CHECKING:
    from splatting.part import Strategy

# Entries of the log's last record: options of the training.
CAP, PLANNED, STRATEGY = "max_num_splats", "iterations_planned", "strategy"
BUDGET = "default_budget"  # Gaussians that --strategy budget takes for the scene where no number is given
LATE_RESET = "opacities are reset"  # how the text of a late reset begins

# Milliseconds of a step at 1600x1060 on an H100: of any, and of a million Gaussians (docs/results/several_gpus.md).
STEP_ALONE, STEP_SHARED = (0.9, 1.25), (2.8, 0.87)
MANY = 2  # times as many are more than the scene needs (docs/results/training.md: better with a fifth)
FULL = 0.99  # of the cap: a densification that removes some Gaussians ends a little below it
SETTLED = 1000  # iterations; the default densification begins after 500, so that a shorter training says little


def check_alone(projection: str, several: bool) -> None:
    """Refuse rays of a training of several processes (UserError)."""
    if several and projection == "ray":
        raise UserError(
            "--projection ray needs a training of one process; leave it out, or start train.py without torchrun"
        )


def check_native(options: argparse.Namespace) -> None:
    """Say where --lenses native, as it was given, comes too late."""
    if getattr(options, "lenses", "") == "native" and already_undistorted(options.source_path):
        print(
            "warning: --lenses native has no effect, since convert.py undistorted the photos of this scene; to train "
            "on them as they were taken, convert again with --lenses native",
            file=sys.stderr,
        )


def warnings_of(run: Any, given: argparse.Namespace) -> Iterator[Finding]:
    """Warnings before a run (splatting/training/run.py). given: the optimisation options as they were given."""
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
    """What to say if one GPU would train `count` Gaussians, as many as there may be, faster than several do."""
    alone, shared = (base + each * count / 1e6 for base, each in (STEP_ALONE, STEP_SHARED))
    if ranks == 1 or not on_gpu or shared < alone:
        return None
    times = f"{alone:.1f} ms on one GPU and {shared:.1f} ms on two"
    text = f"one GPU is faster here: a step with {count:,} Gaussians takes about {times}"
    return Finding(text, "start train.py without torchrun, unless they do not fit on one")


def without_effect(opt: argparse.Namespace, strategy: str) -> Finding | None:
    """What to say of given options that belong to another strategy."""
    others = [option for name in strategies() if name != strategy for option in part_class(name).options.optimisation]
    given = [f"--{option.name}" for option in others if getattr(opt, option.name) != option.default]
    return Finding(f"--strategy {strategy} ignores {some(given)}") if given else None


def late_reset(density: "Strategy", opt: argparse.Namespace, done: int) -> Finding | None:
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
    left = f"the remaining {schedule.ends - due[-1]} iterations are too few to recover"
    return Finding(f"{LATE_RESET} in iteration {due[-1]}, and {left}", remedy)


def another_number(density: "Strategy", opt: argparse.Namespace, count: int, first: int) -> Finding | None:
    """What to say if a strategy cannot reach its number of Gaussians in time.

    count: of Gaussians, now; first: the next iteration. Not known of a run with a time budget.
    """
    schedule, aim, strategy = density.schedule, density.max_gaussians, part_class(opt.strategy)
    if schedule.paced or schedule.schedule_step(first) >= density.ends > 0:
        return None  # what is repeated or resumed has no say in it any more
    ending, start = strategy.until[0], f"--densify_from_iter {opt.densify_from_iter} is not before"
    if 0 < density.ends <= opt.densify_from_iter < schedule.length:
        return Finding(f"{start} --{ending} {density.ends}, so no Gaussians are added", "lower --densify_from_iter")
    reached = density.projected_count(count, first, schedule.ends)
    too_many, too_late = 0 < opt.max_num_splats < count, opt.densify_from_iter >= schedule.length
    remover = next((name for name in strategies() if part_class(name).removes), None)
    if not density.grows_to:
        remedy = f"--strategy {remover} removes the surplus" if remover and not too_late else ""
        text = f"{_start_of(count, opt)}; {opt.strategy} adds none, and removes only faint ones"
        return Finding(text, remedy) if too_many else None
    if reached == aim or ((reached > aim or density.default_is_limit) and not opt.max_num_splats):
        return None
    done = schedule.schedule_step(first) - 1
    # Half of what is left suits rules that need the rest to settle, as those that end late by default do not.
    ends = f"--{ending} {done + (schedule.length - done) // 2}" if strategy.until[1] == 1 / 2 else ""
    scaled = None
    if not done and opt.densify_from_iter < density.ends < schedule.usual:
        scaled = next((remedy(schedule.length) for remedy in tools("for_few_iterations")), None)
    if too_late:
        window = f"--densify_from_iter {done + (schedule.length - done) // 20} {ends}".rstrip()
        why = f"{start} the end; give {scaled or window}"
        if too_many and strategy.removes:
            return Finding(_start_of(count, opt), f"only faint ones are removed, as {why}")
    elif too_many and not strategy.removes:
        why = f"it removes none; --strategy {remover} does"
    elif ends and schedule.length < density.ends:
        why = f"--{ending} {density.ends} is not before the end; give {scaled or ends}"
    else:
        why = density.too_slow()
    return Finding(f"--strategy {opt.strategy} will reach {reached:,} Gaussians, not {aim:,}, as {why}")


def _start_of(count: int, opt: argparse.Namespace) -> str:
    return f"training starts with {count:,} Gaussians, more than --max_num_splats {opt.max_num_splats}"


def what_to_try(rows: Sequence[Row], records: Sequence[Mapping[str, Any]]) -> list[Finding]:
    """Up to two notes after a training; none where nothing was seen that a user could change. Nothing is promised.

    rows: of error_vs_time.csv; only those that score whole sets tell of scores. records: of train_log.json.
    """
    scored = [row for row in whole_sets(rows) if row["test_psnr"] is not None]
    last = records[-1] if records else {}
    strategy = last.get(STRATEGY, "adc")
    # More Gaussians are no remedy for overfitting. Without growth, a cap that is far away is none either.
    first = _overfitting(rows, strategy) or _at_cap(rows, scored, last.get(CAP))
    first = first or _never_grew(rows, strategy) or _many(rows, last.get(BUDGET))
    ended_by_itself = last.get(PLANNED) not in (None, last.get("iteration"))
    return [found for found in (first, None if ended_by_itself else _late(rows, scored)) if found]


def _overfitting(rows: Sequence[Row], strategy: str) -> Finding | None:
    """Test views lose while training views gain."""
    if (gained := gain_since_peak(rows)) is None:
        return None
    best, lost = peak(rows)
    half = max(1, int((rows[-1]["gaussians"] or 0) / 2))
    fewer = f" (--max_num_splats {half}, half as many as now)" if half > 1 else ""
    others = {"adc": "--strategy mcmc or budget with ", "budget": "--strategy mcmc, "}.get(strategy, "")
    seen = f"From iteration {best['iteration']} on only the training photos were fitted (+{gained:.2f} dB), and"
    remedy = f"try {others}fewer Gaussians{fewer}, a lower --sh_degree, or more photos"
    return Finding(f"{seen} the test views lost {lost:.2f} dB", remedy, Severity.NOTE)


def _at_cap(rows: Sequence[Row], scored: Sequence[Row], cap: int | None) -> Finding | None:
    """The number of Gaussians rose to its cap before the end."""
    first = next((row["iteration"] for row in rows if cap and (row["gaussians"] or 0) >= FULL * cap), None)
    if first is None or first == rows[0]["iteration"]:
        return None
    after = [row["test_psnr"] for row in scored if row["iteration"] >= first]
    gained = f"; since then test views changed by {after[-1] - after[0]:+.2f} dB" if len(after) > 1 else ""
    seen = f"From iteration {first} on there was no room for more Gaussians (--max_num_splats {cap}){gained}"
    remedy = "try --strategy budget with the same number, which puts them where the error is, or a higher one, if "
    return Finding(seen, f"{remedy}memory and time allow it", Severity.NOTE)


def _many(rows: Sequence[Row], budget: int | None) -> Finding | None:
    """Adaptive density control made far more Gaussians than --strategy budget takes."""
    count = (rows[-1]["gaussians"] or 0) if rows else 0
    if not 0 < MANY * (budget or 0) <= count:
        return None
    seen = f"There are {count} Gaussians, {count / budget:.1f} times as many as --strategy budget takes"
    remedy = "try that, as fewer take less time, and were often as good"
    return Finding(f"{seen} for these photos ({budget})", remedy, Severity.NOTE)


def _never_grew(rows: Sequence[Row], strategy: str) -> Finding | None:
    """Nothing was densified, or no more than was removed."""
    counts = [row["gaussians"] for row in rows if row["gaussians"] is not None]
    grew = any(after > before for before, after in pairwise(counts))  # from a random start they first become fewer
    if len(counts) < 2 or rows[-1]["iteration"] < SETTLED or grew:
        return None
    remedy = "a lower --densify_grad_threshold" if strategy == "adc" else "a higher --max_num_splats"
    end = part_class(strategy).until[0] if strategy in strategies() else "densify_until_iter"
    counted = f"{counts[0]} at first, {counts[-1]} at the end"
    seen = f"The number of Gaussians never rose from one scoring to the next ({counted}): nothing was densified"
    remedy = f"try {remedy}, and see whether --densify_from_iter and --{end} leave iterations for it"
    return Finding(f"{seen}, or more was removed", remedy, Severity.NOTE)


def _late(rows: Sequence[Row], scored: Sequence[Row]) -> Finding | None:
    """The second half of the seconds changed the test views by less than is clear."""
    if len(scored) < 3 or scored[-1]["iteration"] < SETTLED:
        return None
    end = scored[-1]
    middle = next(row for row in scored if row["seconds"] >= end["seconds"] / 2)
    change = end["test_psnr"] - middle["test_psnr"]
    if middle is end or abs(change) >= CLEAR:
        return None
    tenth = next(row for row in rows if row["iteration"] >= end["iteration"] / 10)
    early, pace = (  # mean milliseconds of training an iteration between two points
        1000 * (after["seconds"] - before["seconds"]) / max(after["iteration"] - before["iteration"], 1)
        for before, after in ((rows[0], tenth), (middle, end))
    )
    slower = f", at {pace:.3g} ms an iteration after {early:.3g} ms at the beginning" if pace > early > 0 else ""
    last = end["seconds"] - middle["seconds"]
    seen = f"The last {last:.1f} of {end['seconds']:.1f} s changed the test views by {change:+.2f} dB{slower}"
    at = middle["iteration"]
    remedy = f"try --iterations {at} --position_lr_max_steps {at}, or fewer Gaussians with --max_num_splats"
    return Finding(seen, remedy, Severity.NOTE)
