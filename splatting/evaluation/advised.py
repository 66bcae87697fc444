"""Advice put to the test: what trainings that follow the scene's data gain over those that do not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from splatting.evaluation.comparison import FITTED, Run, grouped, spread
from splatting.evaluation.plan import options_without_advice

NOTHING, CONFIRMED, REFUTED, UNDECIDED = "nothing asked", "confirmed", "refuted", "undecided"
SURE = 2  # standard errors that a difference must exceed
_APPEARANCE = "--appearance"  # an option that puts photos' exposures aside, so that scores must do so, too


def advice_effects(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Compare the runs that follow advice with those of the same other options and seed; a row for each option set.

    found: the advice, options: what it asks for. plain: the option set without advice. score: the name of the score
    that decides, by `_score`. without, with, difference: its spreads over the `seeds` that both have finished, on the
    same ground truth; error: the standard error of the mean difference, None for one seed. word: CONFIRMED or REFUTED
    if the mean is more than SURE errors away from 0, NOTHING, or UNDECIDED, as also without seeds.
    """
    rows = []
    for (scene, config), members in grouped(runs, "scene", "config").items():
        if (found := next((run["advice"] for run in members if run["advice"] is not None), None)) is None:
            continue
        options = [said["options"] for said in found if said["options"]]
        pairs = _pairs(members, runs)
        score = _score(options, pairs)
        ends = [[_end(run)[score] for run in pair] for pair in pairs]
        gain = spread(None if None in (before, after) else after - before for before, after in ends)
        error = None if gain["std"] is None else gain["std"] / math.sqrt(len(ends))
        seconds = [spread(_end(pair[i])["seconds"] for pair in pairs) for i in (0, 1)]
        rows.append(
            {
                "config": config,
                "difference": gain,
                "error": error,
                "found": found,
                "options": options,
                "plain": pairs[0][0]["config"] if pairs else None,
                "scene": scene,
                "score": score,
                "seconds_with": seconds[1],
                "seconds_without": seconds[0],
                "seeds": [run["seed"] for _, run in pairs],
                "with": spread(after for _, after in ends),
                "without": spread(before for before, _ in ends),
                "word": _word(gain["mean"], error) if options else NOTHING,
            }
        )
    return rows


def _pairs(members: Sequence[Run], runs: Sequence[Run]) -> list[tuple[Run, Run]]:
    """Return each run with that of the same options but for advice, if both finished with the same ground truth."""

    def key(run: Run, options: Sequence[str]) -> tuple[Any, ...]:
        return run["scene"], run["ground_truth_sha256"], tuple(options)

    plain = {key(run, run["options"] or ()): run for run in runs if run["finished"]}
    followed = [(run, options_without_advice(run["options"] or ())) for run in members if run["finished"]]
    found = [(plain.get(key(run, options)), run) for run, options in followed if options is not None]
    return [(other, run) for other, run in found if other]


def _end(run: Run) -> dict[str, Any]:
    return run["iterations"][str(run["final_iteration"])]


def _score(options: Sequence[str], pairs: Sequence[tuple[Run, Run]]) -> str:
    """Return PSNR, or that with the photos' appearance fitted, if advice is about that and all runs have it.

    A photo's own exposure says nothing of the Gaussians, and test photos have theirs, too.
    """
    fitted = f"PSNR_{FITTED}"
    known = all(_end(run)[fitted] is not None for pair in pairs for run in pair)
    return fitted if known and any(_APPEARANCE in words for words in options) else "PSNR"


def _word(mean: float | None, error: float | None) -> str:
    if mean is None or error is None or abs(mean) <= SURE * error:
        return UNDECIDED
    return CONFIRMED if mean > 0 else REFUTED
