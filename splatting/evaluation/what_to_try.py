"""Advice after a training: sentences about what its log and its curve show, each with options to try."""

from collections.abc import Container, Mapping, Sequence
from itertools import pairwise
from typing import Any

from splatting.evaluation.error_curve import Row, best_test, whole_sets
from splatting.registry import part_class, strategies

# Entries of the log's last record: options of the training.
CAP, PLANNED, STRATEGY = "max_num_splats", "iterations_planned", "strategy"
BUDGET = "default_budget"  # Gaussians that --strategy budget takes for the scene where no number is given
FITTED = 18.0  # dB of training views; below, nothing is called overfitting
CLEAR = 0.1  # dB between two points; those of a settled training differed by up to 0.07
MANY = 2  # times as many are more than the scene needs (docs/results/training.md: better with a fifth)
FULL = 0.99  # of the cap: a densification that removes some Gaussians ends a little below it
SETTLED = 1000  # iterations; the default densification begins after 500, so that a shorter training says little

_OVERFITS = (
    "From iteration {at} on only the training photos were fitted (+{gained:.2f} dB), and the test views lost "
    "{lost:.2f} dB; try {others}fewer Gaussians{fewer}, a lower --sh_degree, or more photos"
)
_AT_CAP = (
    "From iteration {at} on there was no room for more Gaussians (--max_num_splats {cap}){gained}; try --strategy "
    "budget with the same number, which puts them where the error is, or a higher one, if memory and time allow it"
)
_MANY = (
    "There are {count} Gaussians, {times:.1f} times as many as --strategy budget takes for these photos ({budget}); "
    "try that, as fewer take less time, and were often as good"
)
_NEVER_GREW = (
    "The number of Gaussians never rose from one scoring to the next ({first} at first, {last} at the end): nothing "
    "was densified, or more was removed; try {remedy}, and see whether --densify_from_iter and {end} leave iterations "
    "for it"
)
_LATE = (
    "The last {last:.1f} of {all:.1f} s changed the test views by {change:+.2f} dB{slower}; try --iterations {at} "
    "--position_lr_max_steps {at}, or fewer Gaussians with --max_num_splats"
)


def what_to_try(rows: Sequence[Row], records: Sequence[Mapping[str, Any]]) -> list[str]:
    """Up to two sentences, without their full stops; none where nothing was seen that a user could change.

    rows: of error_vs_time.csv; only those that score whole sets tell of scores. records: of train_log.json. Each
    sentence says first what was seen, then what to try; nothing is promised.
    """
    scored = [row for row in whole_sets(rows) if row["test_psnr"] is not None]
    last = records[-1] if records else {}
    strategy = last.get(STRATEGY, "adc")
    # More Gaussians are no remedy for overfitting. Without growth, a cap that is far away is none either.
    first = _overfitting(rows, strategy) or _at_cap(rows, scored, last.get(CAP))
    first = first or _never_grew(rows, strategy) or _many(rows, last.get(BUDGET))
    ended_by_itself = last.get(PLANNED) not in (None, last.get("iteration"))
    return [sentence for sentence in (first, None if ended_by_itself else _late(rows, scored)) if sentence]


def gain_since_peak(rows: Sequence[Row]) -> float | None:
    """PSNR that training views gained while test views lost (`peak`); None if either is not CLEAR."""
    found, end = peak(rows), whole_sets(rows)
    # What does not fit the training views cannot overfit.
    if found is None or found[0]["train_psnr"] is None or (end[-1]["train_psnr"] or 0.0) < FITTED:
        return None
    gained = end[-1]["train_psnr"] - found[0]["train_psnr"]
    return None if gained < CLEAR else gained


def _overfitting(rows: Sequence[Row], strategy: str) -> str | None:
    """Test views lose while training views gain."""
    if (gained := gain_since_peak(rows)) is None:
        return None
    best, lost = peak(rows)
    half = max(1, int((rows[-1]["gaussians"] or 0) / 2))
    fewer = f" (--max_num_splats {half}, half as many as now)" if half > 1 else ""
    others = {"adc": "--strategy mcmc or budget with ", "budget": "--strategy mcmc, "}.get(strategy, "")
    return _OVERFITS.format(at=best["iteration"], lost=lost, gained=gained, others=others, fewer=fewer)


def _at_cap(rows: Sequence[Row], scored: Sequence[Row], cap: int | None) -> str | None:
    """The number of Gaussians rose to its cap before the end."""
    first = next((row["iteration"] for row in rows if cap and (row["gaussians"] or 0) >= FULL * cap), None)
    if first is None or first == rows[0]["iteration"]:
        return None
    after = [row["test_psnr"] for row in scored if row["iteration"] >= first]
    gained = f"; since then test views changed by {after[-1] - after[0]:+.2f} dB" if len(after) > 1 else ""
    return _AT_CAP.format(at=first, cap=cap, gained=gained)


def _many(rows: Sequence[Row], budget: int | None) -> str | None:
    """Adaptive density control made far more Gaussians than --strategy budget takes."""
    count = (rows[-1]["gaussians"] or 0) if rows else 0
    return _MANY.format(count=count, times=count / budget, budget=budget) if 0 < MANY * (budget or 0) <= count else None


def _never_grew(rows: Sequence[Row], strategy: str) -> str | None:
    """Nothing was densified, or no more than was removed."""
    counts = [row["gaussians"] for row in rows if row["gaussians"] is not None]
    grew = any(after > before for before, after in pairwise(counts))  # from a random start they first become fewer
    if len(counts) < 2 or rows[-1]["iteration"] < SETTLED or grew:
        return None
    remedy = "a lower --densify_grad_threshold" if strategy == "adc" else "a higher --max_num_splats"
    end = part_class(strategy).until[0] if strategy in strategies() else "densify_until_iter"
    return _NEVER_GREW.format(first=counts[0], last=counts[-1], remedy=remedy, end=f"--{end}")


def _late(rows: Sequence[Row], scored: Sequence[Row]) -> str | None:
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
    return _LATE.format(last=last, all=end["seconds"], change=change, slower=slower, at=middle["iteration"])


def peak(rows: Sequence[Row]) -> tuple[Row, float] | None:
    """The whole-set row with the best test views, and how much PSNR was lost since; None if that is not CLEAR."""
    rows = whole_sets(rows)
    best = best_test(rows)
    if best is None or rows[-1]["test_psnr"] is None:
        return None
    lost = best["test_psnr"] - rows[-1]["test_psnr"]
    return None if lost < CLEAR else (best, lost)


def peak_advice(rows: Sequence[Row], saved: Container[int], steady: bool = True) -> str | None:
    """A line that names the iteration with the best test views; None unless they were clearly worse in the last row.

    saved: iterations whose PLY this training has written, before the iteration's step, so that it is the model that was
    scored. steady: whether another training has the same iterations, which one by the clock has not.
    """
    if (found := peak(rows)) is None:
        return None
    best, lost = found
    at = best["iteration"]
    line = f"Best test PSNR {best['test_psnr']:.2f} dB at iteration {at} ({lost:.2f} above the end)"
    if at in saved:
        return f"{line}. It is saved: render.py --iteration {at}"
    return f"{line}. Keep it: --save_iterations {at}" if steady else line
