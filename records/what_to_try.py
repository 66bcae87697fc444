"""Advice after a training: sentences about what its log and its curve show, each with options to try."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from records.curve_peak import CLEAR
from records.error_curve import Row, whole_sets

# Entries of the log's last record: options of the training.
CAP, PLANNED, STRATEGY = "max_num_splats", "iterations_planned", "strategy"
BUDGET = "default_budget"  # Gaussians that --strategy budget takes for the scene where no number is given
MANY = 2  # times as many are more than the scene needs (docs/guide/strategies.md: better with a fifth)
FULL = 0.99  # of the cap: a densification that removes some Gaussians ends a little below it
SETTLED = 1000  # iterations; the default densification begins after 500, so that a shorter training says little


def what_to_try(rows: Sequence[Row], records: Sequence[Mapping[str, Any]]) -> list[str]:
    """Up to two sentences, without their full stops; none where nothing was seen that a user could change.

    rows: of error_vs_time.csv; only those that score whole sets tell of scores. records: of train_log.json. Each
    sentence says first what was seen, then what to try; nothing is promised.
    """
    scored = [row for row in whole_sets(rows) if row["test_psnr"] is not None]
    last = records[-1] if records else {}
    # More Gaussians are no remedy for overfitting. Without growth, a cap that is far away is none either.
    strategy = last.get(STRATEGY, "adc")
    first = _overfitting(scored, strategy) or _at_cap(rows, scored, last.get(CAP)) or _never_grew(rows, strategy)
    first = first or _many(rows, last.get(BUDGET))
    ended_by_itself = last.get(PLANNED) not in (None, last.get("iteration"))
    return [sentence for sentence in (first, None if ended_by_itself else _late(rows, scored)) if sentence]


def _overfitting(scored: Sequence[Row], strategy: str) -> str | None:
    """Test views lose while training views gain."""
    best = max(scored, key=lambda row: row["test_psnr"], default=None)
    if best is None or None in (best["train_psnr"], scored[-1]["train_psnr"]):
        return None
    lost = best["test_psnr"] - scored[-1]["test_psnr"]
    gained = scored[-1]["train_psnr"] - best["train_psnr"]
    if lost < CLEAR or gained < CLEAR:
        return None
    half = max(1, int((scored[-1]["gaussians"] or 0) / 2))
    fewer = f" (--max_num_splats {half}, half as many as now)" if half > 1 else ""
    others = {"adc": "--strategy mcmc or budget with ", "budget": "--strategy mcmc, "}.get(strategy, "")
    return (
        f"After iteration {best['iteration']} the test views lost {lost:.2f} dB while the training views gained "
        f"{gained:.2f} dB, so it overfits; try {others}fewer Gaussians{fewer}, a lower --sh_degree, or more photos"
    )


def _at_cap(rows: Sequence[Row], scored: Sequence[Row], cap: int | None) -> str | None:
    """The number of Gaussians reached its cap before the end."""
    first = next((row for row in rows if cap and (row["gaussians"] or 0) >= FULL * cap), None)
    if first is None:
        return None
    after = [row["test_psnr"] for row in scored if row["iteration"] >= first["iteration"]]
    gained = f"; since then test views changed by {after[-1] - after[0]:+.2f} dB" if len(after) > 1 else ""
    return (
        f"From iteration {first['iteration']} on there was no room for more Gaussians (--max_num_splats {cap})"
        f"{gained}; try --strategy budget with the same number, which puts them where the error is, or a higher one, "
        "if memory and time allow it"
    )


def _many(rows: Sequence[Row], budget: int | None) -> str | None:
    """Adaptive density control made far more Gaussians than --strategy budget takes."""
    count = (rows[-1]["gaussians"] or 0) if rows else 0
    if not budget or count < MANY * budget:
        return None
    return (
        f"There are {count} Gaussians, {count / budget:.1f} times as many as --strategy budget takes for these photos "
        f"({budget}); try that, as fewer take less time, and were often as good"
    )


def _never_grew(rows: Sequence[Row], strategy: str) -> str | None:
    """Nothing was densified, or no more than was removed."""
    counts = [row["gaussians"] for row in rows if row["gaussians"] is not None]
    grew = any(after > before for before, after in pairwise(counts))  # from a random start they first become fewer
    if len(counts) < 2 or rows[-1]["iteration"] < SETTLED or grew:
        return None
    remedy = "a lower --densify_grad_threshold" if strategy == "adc" else "a higher --max_num_splats"
    end = "--mcmc_until_iter" if strategy == "mcmc" else "--densify_until_iter"
    return (
        f"The number of Gaussians never rose from one scoring to the next ({counts[0]} at first, {counts[-1]} at the "
        f"end): nothing was densified, or more was removed; try {remedy}, and see whether "
        f"--densify_from_iter and {end} leave iterations for it"
    )


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
    early, pace = _milliseconds(rows[0], tenth), _milliseconds(middle, end)
    slower = f", at {pace:.3g} ms an iteration after {early:.3g} ms at the beginning" if pace > early > 0 else ""
    return (
        f"The last {end['seconds'] - middle['seconds']:.1f} of {end['seconds']:.1f} s changed the test views by "
        f"{change:+.2f} dB{slower}; try --iterations {middle['iteration']} --position_lr_max_steps "
        f"{middle['iteration']}, or fewer Gaussians with --max_num_splats"
    )


def _milliseconds(before: Mapping[str, Any], after: Mapping[str, Any]) -> float:
    """Mean milliseconds of training an iteration between two points."""
    return 1000 * (after["seconds"] - before["seconds"]) / max(after["iteration"] - before["iteration"], 1)
