"""Curves of other programs: the CSV, its making from hand-made outputs of theirs, and how a report shows them."""

import contextlib
import json
import math
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from scipy import stats

from applications.evaluation import peer_curve
from benchmarks.peers import targets
from benchmarks.peers.time_to_target import ecdf
from splatting.records.error_curve import COLUMNS, PEER_COLUMNS, peers_of, read_peer, write_curve, write_peer
from utils.system_utils import UserError


def written(path: Path, *lines: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_curve_may_have_few_columns_in_any_order(tmp_path):
    file = written(tmp_path / "a.csv", "test_psnr,colour,seconds", "21.5,red,20", "", "20.0,,7")
    rows = read_peer(file)
    assert [set(row) for row in rows] == [set(PEER_COLUMNS)] * 2
    assert [(row["seconds"], row["test_psnr"], row["test_ssim"]) for row in rows] == [(7, 20, None), (20, 21.5, None)]
    write_peer(tmp_path / "b.csv", rows)
    assert (tmp_path / "b.csv").read_text() == "seconds,test_psnr\n7,20\n20,21.5\n"
    assert read_peer(tmp_path / "b.csv") == rows

    ours = dict.fromkeys(COLUMNS) | {"iteration": 7, "seconds": 1.5, "test_psnr": 20.0, "gaussians": 5}
    write_curve(tmp_path / "a.csv", [ours | {"subset": 2}, ours])  # a curve of train.py is one: what scores all views
    assert read_peer(tmp_path / "a.csv") == [{name: ours.get(name) for name in PEER_COLUMNS}]


@pytest.mark.parametrize(("lines", "sentence"), [
    (("seconds,psnr", "1,2"), "has no column test_psnr"),
    (("seconds,test_psnr",), "has no points"),
    (("seconds,test_psnr", "1"), "is not a curve"),
    (("seconds,test_psnr", "1,"), "a row without test_psnr"),
    (("seconds,test_psnr", "1,inf"), "test_psnr is inf"),
    (("seconds,test_psnr", "0,20"), "seconds are 0, and must be above 0"),
    (("seconds,test_psnr", "one,20"), "could not convert"),
])  # fmt: skip
def test_files_that_are_no_curves(tmp_path, lines, sentence):
    with pytest.raises(UserError, match=sentence):
        read_peer(written(tmp_path / "a.csv", *lines))


def test_a_peer_belongs_to_a_scene(tmp_path):
    file = written(tmp_path / "a.csv", "seconds,test_psnr", "7,20")
    (peer,) = peers_of([["other", str(file)]], ["attic"])
    assert (peer["scene"], peer["name"], peer["file"]) == ("attic", "other", str(file))
    peers = peers_of([["attic/other", str(file)], ["brick/other", str(file)]], ["attic", "brick"])
    assert [(peer["scene"], peer["name"]) for peer in peers] == [("attic", "other"), ("brick", "other")]
    for name in ("other", "cellar/other", "attic/"):
        with pytest.raises(UserError, match="name the scene, too"):
            peers_of([[name, str(file)]], ["attic", "brick"])
    with pytest.raises(UserError, match="is given twice"):
        peers_of([["other", str(file)]] * 2, ["attic"])


def _result_of_gsplat(folder: Path) -> Path:
    """Write the files of gsplat's trainer at two scored steps; a third was not saved, so its seconds are not known."""
    for step, seconds, psnr in ((6999, 40.5, 28.25), (29999, 201.0, 30.5)):
        scores = {"psnr": psnr, "ssim": 0.9, "lpips": 0.12, "ellipse_time": 0.004, "num_GS": 5000}
        costs = {"mem": 1.5, "ellipse_time": seconds, "num_GS": 5000}
        written(folder / "stats" / f"val_step{step:04d}.json", json.dumps(scores))
        written(folder / "stats" / f"train_step{step:04d}_rank0.json", json.dumps(costs))
    written(folder / "stats" / "val_step9999.json", json.dumps({"psnr": 29}))
    return folder


def test_gsplats_seconds_are_those_of_training_not_of_a_render(tmp_path):
    first, last = peer_curve.from_gsplat(_result_of_gsplat(tmp_path))
    assert (first["iteration"], first["seconds"], first["test_psnr"]) == (7000, 40.5, 28.25)
    assert (last["iteration"], last["seconds"], last["test_psnr"]) == (30000, 201.0, 30.5)
    assert (first["peak_memory_mib"], first["gaussians"], first["test_lpips"]) == (1536, 5000, 0.12)
    with pytest.raises(UserError, match="whose --save_steps are its --eval_steps"):
        peer_curve.from_gsplat(tmp_path / "stats" / "nothing")


LOG = """Optimizing output/a [31/12 23:58:00]
Output folder: output/a [31/12 23:58:00]
Number of points at initialisation :  1000 [31/12 23:58:10]
Training progress:  10%|#  | 500/5000 [00:20<03:00, Loss=0.1] [31/12 23:58:55]
[ITER 500] Saving Gaussians [31/12 23:58:56]
 [31/12 23:59:50]
[ITER 1000] Evaluating test: L1 0.03125 PSNR 24.5 [31/12 23:59:50]
 [31/12 23:59:52]
[ITER 1000] Evaluating train: L1 0.025 PSNR 26.5 [31/12 23:59:52]
 [01/01 00:03:10]
[ITER 5000] Evaluating test: L1 0.02 PSNR 27.125 [01/01 00:03:10]

Training complete. [01/01 00:03:11]
"""


def test_the_references_console_output_across_a_new_year(tmp_path):
    rows = peer_curve.from_log(written(tmp_path / "log.txt", LOG))
    found = [(row["iteration"], row["seconds"], row["test_psnr"], row.get("train_psnr")) for row in rows]
    assert found == [(1000, 100, 24.5, 26.5), (5000, 300, 27.125, None)]


def test_console_outputs_without_what_is_needed(tmp_path):
    for text, sentence in (
        ("nothing\n", "has no scores of test views"),
        ("[ITER 7] Evaluating test: L1 0.1 PSNR 20.0\n", "has no times at the ends of its lines"),
        ("a [31/02 10:00:00]\n", "whose time does not exist: .31/02 10:00:00."),
    ):
        with pytest.raises(UserError, match=sentence):
            peer_curve.from_log(written(tmp_path / "log.txt", text))


READER = "tensorboard.backend.event_processing.event_accumulator"


class Scalar(NamedTuple):
    """A scalar as TensorBoard's reader gives it."""

    wall_time: float
    step: int
    value: float


@pytest.fixture
def tensorboard(monkeypatch) -> dict[str, list[Scalar]]:
    """The scalars that a stand-in for TensorBoard's reader finds in any folder."""
    found: dict[str, list[Scalar]] = {}

    class Accumulator:
        def __init__(self, folder: str, sizes: dict[str, int]) -> None:
            assert sizes == {"scalars": 0}
            self.Reload, self.Tags, self.Scalars = lambda: self, lambda: {"scalars": [*found]}, found.__getitem__

    monkeypatch.setitem(sys.modules, READER, SimpleNamespace(EventAccumulator=Accumulator))
    return found


def _fill(found: dict[str, list[Scalar]], scored: tuple[int, ...], last: int, every: int = 1) -> None:
    """Iterations of 0.1 s, the first one logged at 1000.1 s; each scored one is followed by a pause of 60 s."""
    scores, points, times, wall = [], [], [], 1000.0
    for step in range(1, last + 1):
        wall += 0.1
        if step % every == 0 or step == 1:
            times.append(Scalar(wall, step, 100.0))
        if step in scored:
            scores.append(Scalar(wall + 50, step, 20 + step / 100))
            points.append(Scalar(wall + 50, step, 10.0 * step))
            wall += 60
    found |= {"iter_time": times, "test/loss_viewpoint - psnr": scores, "total_points": points}


def test_the_references_tensorboard_files_give_seconds_without_pauses(tmp_path, tensorboard):
    _fill(tensorboard, (100, 200, 300), 300, every=10)
    rows = peer_curve.from_events(tmp_path)
    assert [row["iteration"] for row in rows] == [100, 200, 300]
    assert [row["seconds"] for row in rows] == pytest.approx([10, 20, 30], abs=1e-3)
    assert [row["wall_seconds"] for row in rows] == pytest.approx([60, 130, 200], abs=1e-3)
    assert [row["test_psnr"] for row in rows] == [21, 22, 23] and rows[1]["gaussians"] == 2000


def test_the_command(tmp_path, monkeypatch, capsys, tensorboard):
    _fill(tensorboard, (5, 9), 9)
    events, of_gsplat = written(tmp_path / "m/events.out.tfevents.1.host", "").parent, _result_of_gsplat(tmp_path / "g")
    out = tmp_path / "out.csv"
    for kind, source, iterations, sentence in (
        ("gsplat", of_gsplat, [7000, 30000], "contain the scoring and saving"),
        ("reference", events, [5, 9], "are of training, without scoring"),
        ("reference", written(tmp_path / "log", LOG), [1000, 5000], "whole seconds"),
        ("gsplat", tmp_path / "nowhere", None, "there is no"),
        ("reference", of_gsplat, None, "has no TensorBoard files; give a saved console output"),
    ):
        monkeypatch.setattr(sys, "argv", ["peer_curve", kind, str(source), str(out)])
        with pytest.raises(UserError, match=sentence) if iterations is None else contextlib.nullcontext():
            peer_curve.main()
            said = capsys.readouterr().out
            assert "wrote 2 points to" in said and sentence in said
            assert [row["iteration"] for row in read_peer(out)] == iterations


QUICK = [(1.0, 29.0), (2.0, 29.6), (4.0, 29.4)]  # never within 0.2 dB of 30
SLOW = [(8.0, 29.9), (16.0, 30.0)]


def test_the_distribution_is_scipys():
    """Values above 6 never arrive: for scipy, later than all others."""
    values = np.round(np.random.default_rng(0).exponential(5, 200), 1)  # with equal ones
    known = values[values <= 6]
    theirs = stats.ecdf(stats.CensoredData(known, right=np.full(len(values) - len(known), 1e9))).cdf
    places, shares = ecdf(np.where(values > 6, np.inf, values).tolist())
    assert places == sorted({*known.tolist()}) and shares == pytest.approx(theirs.evaluate(places), abs=1e-12)
    assert shares[-1] == pytest.approx(len(known) / len(values)) and ecdf([math.inf]) == ([], [])


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
