"""Seconds until a training is near the best known: by hand-made curves, and beside scipy's distribution."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from benchmarks.peers import targets
from benchmarks.peers.time_to_target import (
    Curve,
    best_known,
    comparable,
    ecdf,
    performance_profile,
    reached,
    seconds_to_reach,
    times,
)
from utils.system_utils import UserError

NEVER = math.inf
QUICK = [(1.0, 29.0), (2.0, 29.6), (4.0, 29.4)]  # never within 0.2 dB of 30
SLOW = [(8.0, 29.9), (16.0, 30.0)]


def test_the_first_sample_counts_and_nothing_is_interpolated():
    assert seconds_to_reach(QUICK, 29.5) == 2 and seconds_to_reach(QUICK, 29.0) == 1
    assert seconds_to_reach(SLOW, 29.95) == 16 and seconds_to_reach(QUICK, 29.61) == NEVER


def test_the_best_known_is_of_all_points_of_a_scene_and_of_the_first_of_equals():
    curves = [
        Curve("a", "p", "", QUICK),
        Curve("a", "q", "", SLOW),
        Curve("a", "r", "", SLOW),
        Curve("b", "p", "", QUICK),
    ]
    assert best_known(curves) == {"a": (30.0, "q"), "b": (29.6, "p")}
    kept, left_out = comparable(curves)
    assert left_out == ["q", "r"] and kept == [curves[0], curves[3]]


def test_a_run_that_never_arrives_counts_in_share_and_median():
    curves = [Curve("a", "p", str(n), points) for n, points in enumerate((QUICK, SLOW, SLOW))]
    best = best_known(curves)
    assert times(curves, best, 0.5) == {"p": [2, 8, 8]} and times(curves, best, 0.1) == {"p": [NEVER, 8, 8]}
    assert reached([2, 8, 8]) == (3, 8) and reached([NEVER, 8, 8]) == (2, 8)
    assert reached([NEVER, 8]) == (1, NEVER) and reached([NEVER, NEVER, 1]) == (1, NEVER)


def test_the_distribution_is_scipys():
    rng = np.random.default_rng(0)
    values = np.round(rng.exponential(5, 200), 1)  # with equal ones
    theirs = stats.ecdf(values).cdf
    places, shares = ecdf(values.tolist())
    assert places == theirs.quantiles.tolist() and shares == pytest.approx(theirs.probabilities, abs=1e-12)

    late = np.where(values > 6, np.inf, values)  # never: for scipy, later than all others
    known = late[np.isfinite(late)]
    theirs = stats.ecdf(stats.CensoredData(known, right=np.full(len(late) - len(known), 1e9))).cdf
    places, shares = ecdf(late.tolist())
    assert shares == pytest.approx(theirs.evaluate(places), abs=1e-12)
    assert places[-1] <= 6 and shares[-1] == pytest.approx(len(known) / len(late)) and shares[-1] < 1
    assert ecdf([NEVER]) == ([], [])


def test_a_performance_profile_counts_unsolved_problems():
    """Two scenes with targets of 0.5 and 0.1 dB. On b, one of the runs of `slow` arrives, so its median never does."""
    curves = [
        *(Curve("a", "quick", "", QUICK), Curve("a", "slow", "", SLOW)),
        *(
            Curve("b", "quick", "", [(3.0, 20.0)]),
            Curve("b", "slow", "0", [(6.0, 20.0)]),
            Curve("b", "slow", "1", QUICK[:1]),
        ),
    ]
    best = {"a": (30.0, "slow"), "b": (20.0, "quick")}
    assert performance_profile(curves[:4], best, (0.5, 0.1)) == {
        "quick": ([1.0], [3 / 4]),  # the first on a at 0.5 dB, and on b; never on a at 0.1
        "slow": ([1.0, 2.0, 4.0], [1 / 4, 3 / 4, 1.0]),
    }
    harder = best | {"b": (29.0, "slow")}
    assert performance_profile(curves, harder, (0.1,)) == {"quick": ([], []), "slow": ([1.0], [1 / 2])}


def _written(path: Path, points: list[tuple[float, float]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("seconds,test_psnr\n" + "".join(f"{seconds},{psnr}\n" for seconds, psnr in points))


def test_the_command_finds_scenes_programs_and_seeds_in_the_names_of_folders(tmp_path, monkeypatch, capsys):
    out, stored, figures = (tmp_path / name for name in ("out", "stored", "figures"))
    for scene in "ab":
        _written(out / scene / "adc" / "seed_0" / "error_vs_time.csv", SLOW)
        _written(out / scene / "adc" / "seed_1" / "error_vs_time.csv", QUICK)
        _written(stored / "gsplat" / scene / "mcmc_seed0.csv", QUICK)
        _written(stored / "gsplat" / scene / "notes.csv", QUICK)
    _written(out / "a" / "gsplat" / "peer.csv", QUICK)
    _written(stored / "faster" / "a.csv", [(5.0, 31.0)])
    _written(stored / "faster" / "c.csv", SLOW)
    monkeypatch.setattr(sys, "argv", ["targets", str(out), "--stored", str(stored), "--figures", str(figures)])
    targets.main()
    said = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in said.splitlines() if line.startswith("|")]
    assert ["a", "31.00", "faster"] in rows and ["b", "30.00", "adc"] in rows
    assert "lack a scene: gsplat, faster." in said and "one that never arrives counts as never" in said
    assert ["adc", "4", "2", "50 %", "never", "25 %", "never", "25 %", "never"] in rows
    assert ["gsplat mcmc", "2", "3", "50 %", "never", "0 %", "never", "0 %", "never"] in rows
    for name in ("time_to_target", "performance_profile"):
        assert (figures / f"{name}.png").read_bytes().startswith(b"\x89PNG")

    _written(out / "a" / "adc" / "seed_0" / "peer.csv", QUICK)
    with pytest.raises(UserError, match="two curves are of a adc seed_0"):
        targets.main()
    monkeypatch.setattr(sys, "argv", ["targets", str(stored / "faster" / "a.csv"), "--figures", str(figures)])
    with pytest.raises(UserError, match="give an output of full_eval.py"):
        targets.main()
