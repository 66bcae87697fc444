"""Seconds until a training is near the best known: by hand-made curves, and beside scipy's distribution."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from benchmarks.peers import targets
from benchmarks.peers.time_to_target import (
    ecdf,
)
from utils.system_utils import UserError

NEVER = math.inf
QUICK = [(1.0, 29.0), (2.0, 29.6), (4.0, 29.4)]  # never within 0.2 dB of 30
SLOW = [(8.0, 29.9), (16.0, 30.0)]


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
