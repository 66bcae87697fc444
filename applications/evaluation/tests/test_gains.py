"""Gains on the same seeds: intervals and p values beside SciPy's, Holm's correction, and verdicts."""

import numpy as np
import pytest
from report_runs import run_of
from scipy import stats

from applications.evaluation.gains import compute_gains, compute_interval, correct_holm, judge_gain
from applications.evaluation.report import make_report
from applications.evaluation.tables import make_gains_table


@pytest.mark.parametrize("seed", range(5))
def test_intervals_are_those_of_a_paired_t_test(seed):
    random = np.random.default_rng(seed)
    one, other = random.normal(30, 1, 7), random.normal(30.2, 1, 7)
    found, test = compute_interval((one - other).tolist()), stats.ttest_rel(one, other)
    bounds = test.confidence_interval(0.95)
    assert found["p"] == pytest.approx(test.pvalue)
    assert (found["mean"] - found["half"], found["mean"] + found["half"]) == pytest.approx(tuple(bounds))


@pytest.mark.parametrize(("count", "seen"), [(3, 0.75), (9, 0.23)])
def test_what_so_many_seeds_can_show(count, seen):
    """The differences vary by 0.3 dB."""
    spread = np.linspace(-1, 1, count)
    assert compute_interval((0.3 * spread / spread.std(ddof=1)).tolist())["half"] == pytest.approx(seen, abs=0.005)


def test_holms_correction():
    """By hand: the smallest times 4, the next times 3, and never less than the one before."""
    assert correct_holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert correct_holm([]) == [] and correct_holm([0.7]) == [0.7] and correct_holm([0.6, 0.9]) == [1.0, 1.0]


@pytest.mark.parametrize(
    ("differences", "said"),
    [
        ([0.5, 0.6, 0.55, 0.5], "gains"),
        ([-0.5, -0.6, -0.55], "costs"),
        ([0.0, 0.0], "same scores"),
        ([0.02, -0.03, 0.01, 0.0, 0.02, -0.02], "no difference above 0.02 dB"),
        ([0.5, -0.6, 0.4], "not decided"),
        ([0.1, 0.1], "gains"),
    ],
)
def test_verdicts(differences, said):
    assert judge_gain(compute_interval(differences)) == said


def _runs(scene: str, **ends: list[float]) -> list[dict]:
    return [
        run_of(name, seed, (1, 20.0, 10), (2, end, 10), scene=scene)
        for name, values in ends.items()
        for seed, end in enumerate(values)
    ]


def test_seeds_are_paired_and_scenes_corrected_together():
    base = [30.0, 31.0, 29.0]
    better = [end + gain for end, gain in zip(base, (0.5, 0.52, 0.54), strict=True)]
    runs = _runs("attic", none=base, option=better, single=base[:1]) + _runs(
        "barn", none=base, option=[30.1, 30.9, 29.1]
    )
    found = compute_gains(runs)
    assert found["attic"]["default"] == "none" and list(found["attic"]["sets"]) == ["option"]
    row = found["attic"]["sets"]["option"]
    alone = compute_interval([0.5, 0.52, 0.54])
    assert row["mean"] == pytest.approx(0.52) and row["half"] == pytest.approx(alone["half"])
    assert row["p"] == pytest.approx(2 * alone["p"]) and row["verdict"] == "gains" and row["seeds"] == 3
    table = make_gains_table(found["attic"])
    assert table.rows == [["option", "3", "+0.52 ± 0.05", "gains"]]
    assert (
        compute_gains(_runs("attic", none=base)) == {}
        and compute_gains(_runs("attic", none=[30.0], option=[31.0])) == {}
    )
    assert make_report(["full_eval.py"], runs)["gains"] == found
