"""train.py on tiny scenes: order of a step, resume, threads, interruption, refusals."""

import argparse
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData
from waiting import wait_for

import train
from arguments import read_stored_options
from scene.gaussians.checkpoint import load_checkpoint
from scene.readers.point_cloud import write_point_cloud
from scene.saved_model import read_model
from splatting import run
from splatting.iteration import ViewOrder
from splatting.records.training_log import Stopwatch, TrainingLog
from utils.system_utils import UserError

ROOT = Path(__file__).parents[1]
SMALL = ["-r", "24", "--test_iterations", "-1"]


def _train(scene: Path, out: Path, *more: object, iterations: int) -> Path:
    train.main(["-s", str(scene), "-m", str(out), "--iterations", str(iterations), *SMALL, *map(str, more)])
    return out / "point_cloud" / f"iteration_{iterations}" / "point_cloud.ply"


def _steps(checkpoint: Path) -> list[float]:
    """Adam's step counters by group; NaN if there is no state."""
    state = load_checkpoint(checkpoint)[0][10]["state"]
    return [state[i]["step"].item() if i in state else float("nan") for i in range(6)]


def test_order_of_a_step(colmap_scene, tmp_path):
    """A save precedes the step. The last iteration and densifications take no step, nor do opacities in a reset."""
    every = [str(t) for t in range(1, 16)]
    _train(
        colmap_scene, tmp_path, "--save_iterations", *every, "--checkpoint_iterations", *every,
        "--densify_from_iter", 5,
        "--densification_interval", 8, "--opacity_reset_interval", 10, "--densify_grad_threshold", 1e-5,
        iterations=15,
    )  # fmt: skip
    steps = {t: _steps(tmp_path / f"chkpnt{t}.pth") for t in range(1, 16)}
    assert steps[1] == [1] * 6
    assert steps[7] == [7] * 6 and steps[8] == [7] * 6  # 8 densified
    assert steps[9] == [8] * 6
    assert steps[10] == [9, 9, 9, 8, 9, 9]  # 10 reset the opacities
    assert steps[11] == [10, 10, 10, 9, 10, 10] and steps[15] == steps[14]  # no step in the last
    for t in (3, 7, 11, 15):
        saved = read_model(tmp_path / f"point_cloud/iteration_{t}/point_cloud.ply")
        assert torch.equal(saved._xyz, load_checkpoint(tmp_path / f"chkpnt{t - 1}.pth")[0][1])
    first = read_model(tmp_path / "point_cloud/iteration_1/point_cloud.ply")._xyz
    vertex = PlyData.read(tmp_path / "input.ply")["vertex"]
    points = torch.from_numpy(np.stack([vertex[axis] for axis in "xyz"], axis=1))
    assert torch.equal(first.detach().unique(dim=0), points.unique(dim=0))
    before, after = (load_checkpoint(tmp_path / f"chkpnt{t}.pth")[0][1] for t in (7, 8))
    assert len(after) > len(before)


def test_every_view_once_an_epoch():
    cameras = [f"view {i}" for i in range(7)]
    order = ViewOrder(cameras, seed=3)
    seen = [order[t] for t in range(1, 22)]
    for epoch in range(3):
        assert sorted(seen[7 * epoch : 7 * epoch + 7]) == cameras
    assert seen[:7] != seen[7:14]
    late = ViewOrder(cameras, seed=3)
    assert [late[t] for t in (18, 3, 21)] == [seen[17], seen[2], seen[20]]


def test_learning_and_what_is_said(colmap_scene, tmp_path, capfd):
    _train(colmap_scene, tmp_path, "--eval", "--test_iterations", "1", "300", iterations=300)
    said, shown = capfd.readouterr()
    assert "Gaussians=300" in shown and "the model is worse" not in shown
    for line in (
        rf"Optimizing {tmp_path}",
        r"Number of points at initialisation :  300",
        r"\[ITER 300\] Evaluating test: L1 [\d.e-]+ PSNR [\d.]+ .*",
        r"Training complete\.",
    ):
        assert re.search(rf"^{line} \[\d\d/\d\d \d\d:\d\d:\d\d\]$", said, re.MULTILINE), line
    log = json.loads((tmp_path / "train_log.json").read_text())
    assert [record["iteration"] for record in log] == [1, 300]
    assert log[1]["gaussians"] == 300 and log[1]["seconds"] > log[0]["seconds"]
    # Measured: from 8.5 to 20.1 dB on the training views and 17.9 on the test views.
    assert log[1]["train_psnr"] > 18
    assert log[1]["test_psnr"] > 16


@pytest.mark.parametrize(
    ("interval", "degree", "iterations", "said"),
    [
        (2, 2, 8, ""),
        (1000, 3, 60, ""),  # a training of less than an interval trains all bands, in the same share
        (4, 3, 4, "; no SH band was trained: 73"),
        (4, 3, 6, "; no SH band above degree 1 was: 58"),
    ],
)
def test_sh_degree_rises_every_interval_up_to_its_maximum(
    colmap_scene, tmp_path, monkeypatch, capsys, interval, degree, iterations, said
):
    """Bands that were never trained are told, with what leaves them out."""
    assert run.SH_INTERVAL == 1000
    monkeypatch.setattr("splatting.run.SH_INTERVAL", interval)
    every = range(1, min(iterations, 8) + 1)
    words = "--sh_degree", degree, "--checkpoint_iterations", *every
    _train(colmap_scene, tmp_path, *words, iterations=iterations)
    active = [load_checkpoint(tmp_path / f"chkpnt{t}.pth")[0][0] for t in every]
    assert active == [min(t // min(interval, 2 if interval > iterations else interval), degree) for t in every]
    bands, _, share = said.partition(": ")
    printed = capsys.readouterr().out
    assert bands in printed and (f"{share} % of it: --prune_sh 0 leaves them out" in printed) == bool(said)
    assert said or "their zeros" not in printed


@pytest.mark.slow
def test_a_terminated_run_leaves_whole_files(colmap_scene, tmp_path):
    """While its threads decode photos. tests.kills: one that is killed."""
    for path in (colmap_scene / "images").rglob("*.png"):
        Image.open(path).resize((1200, 800)).save(path)
    every = list(map(str, range(1, 3000)))
    command = [sys.executable, "train.py", "-s", colmap_scene, "-m", tmp_path / "out", "--iterations", "100000", *SMALL,
               "--images_to_load", 4, "--save_iterations", *every, "--checkpoint_iterations", *every]  # fmt: skip
    with subprocess.Popen(list(map(str, command)), cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as run:
        wait_for(lambda: (tmp_path / "out" / "chkpnt20.pth").exists() or run.poll() is not None, 120)
        run.terminate()
        _, error = run.communicate(timeout=60)
    assert run.returncode == 143, error.decode()
    assert b"Traceback" not in error and b"***" not in error  # glog's stack dumps contain these
    assert b"with --start_checkpoint" in error
    plys = list((tmp_path / "out" / "point_cloud").glob("iteration_*/point_cloud.ply"))
    assert len(plys) >= 20
    for ply in plys:
        assert len(read_model(ply)) == 300
    for checkpoint in (tmp_path / "out").glob("chkpnt*.pth"):
        load_checkpoint(checkpoint)


def test_refusals_before_anything_is_written(colmap_scene, blender_scene, tmp_path):
    out = tmp_path / "out"
    ply = _train(colmap_scene, tmp_path / "other", "--checkpoint_iterations", 2, iterations=2)
    checkpoint, empty = tmp_path / "other" / "chkpnt2.pth", tmp_path / "empty.ply"
    write_point_cloud(empty, np.zeros((0, 3)), np.zeros((0, 3)))
    cases = {
        "is a PLY": ["--start_checkpoint", ply],
        "is a folder": ["--start_checkpoint", tmp_path / "other"],
        "no checkpoint": ["--start_checkpoint", tmp_path / "absent.pth"],
        "leaves nothing to do": ["--start_checkpoint", checkpoint, "--iterations", 2],
        "save_iterations": ["--save_iterations", 0],
        "checkpoint_iterations": ["--checkpoint_iterations", -5],
        "--test_iterations takes iterations from 1 on": ["--test_iterations", 0],
        "-r) 100000 is too wide": ["-r", 100_000],
        "--iterations": ["--iterations", -1],
        "absent": ["-s", tmp_path / "absent"],
        "sh_degree": ["--start_checkpoint", checkpoint, "--sh_degree", 1],
        "no points": ["--init_pcd_path", empty],
        "--sparse_depth": ["--sparse_depth", -1],
        "--sparse_depth needs a COLMAP model with tracks": ["-s", blender_scene, "--sparse_depth", 1],
        "--refine_poses needs a COLMAP model with tracks": ["-s", blender_scene, "--refine_poses"],
        "--sky does not work with --strategy mcmc": ["--sky", "auto", "--strategy", "mcmc"],
        "--train_test_exp means --appearance affine": ["--train_test_exp", "--appearance", "ppisp"],
        "--paused needs --viewer": ["--paused"],
        **({"between 0": ["--viewer", 70_000]} if (ROOT / "applications").is_dir() else {}),
        "--resume needs -m": ["-m", "", "--resume"],
    }
    for words, options in cases.items():
        with pytest.raises(UserError, match=re.escape(words)):
            _train(colmap_scene, out, *options, iterations=5)
        assert not out.exists(), words


def test_a_resumed_run_keeps_the_inputs_of_its_folder(colmap_scene, tmp_path):
    out = tmp_path / "out"
    _train(colmap_scene, out, "--checkpoint_iterations", 2, iterations=2)
    (out / "cameras.json").write_text("mine")
    checkpoint = out / "chkpnt2.pth"
    _train(colmap_scene, out, "--start_checkpoint", checkpoint, iterations=3)
    assert (out / "cameras.json").read_text() == "mine"
    _train(colmap_scene, tmp_path / "new", "--start_checkpoint", checkpoint, iterations=3)
    assert (tmp_path / "new" / "cameras.json").exists() and (tmp_path / "new" / "input.ply").exists()


@pytest.mark.parametrize("content", ["{broken", '[{"iter": 1}]', "5", '[{"iteration": 1, "seconds": "x"}]', "\xff"])
def test_a_damaged_log_is_no_reason_to_stop(tmp_path, capsys, content):
    path = tmp_path / "train_log.json"
    path.write_bytes(content.encode("latin-1"))
    log = TrainingLog(tmp_path, 5)
    assert re.fullmatch(r"warning: .*train_log.json cannot be read .*\n", capsys.readouterr().err)
    log.add(6, 1.5, loss=0.25)
    log.add(6, 2.5, loss=0.5, gaussians=3)
    (record,) = json.loads(path.read_text())
    assert record.pop("wall_seconds") > 0 and record.pop("peak_memory_mib") > 0
    assert record == {"iteration": 6, "seconds": 2.5, "loss": 0.5, "gaussians": 3}
    again = TrainingLog(tmp_path, 6)
    assert again.loss == 0.5
    again.add(7, 1.0)
    assert again.records[-1]["seconds"] == 3.5


def test_a_stopwatch_stands_still_in_a_pause_and_counts_one_in_another_once(monkeypatch):
    now = [100.0]
    monkeypatch.setattr("splatting.records.training_log.running_seconds", lambda: now[0])
    clock = Stopwatch()
    now[0] += 2
    with pytest.raises(ZeroDivisionError), clock.paused("viewing"):
        now[0] += 600
        assert clock.seconds == 2
        with clock.paused("saving"):
            now[0] += 4
            assert clock.seconds == 2
        now[0] += 10
        _ = 1 / 0
    now[0] += 3
    assert clock.seconds == 5 and clock.spent == {"viewing": 610, "saving": 4}


@pytest.mark.parametrize("options", [{}, {"depths": "", "train_test_exp": False}, {"seed": 3, "antialiasing": True}])
def test_the_output_folder_is_made_for_other_code_too(tmp_path, monkeypatch, options):
    """With the options of either release, or with all of them in one record."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OAR_JOB_ID", "a_long_job_id")
    writer = object()
    monkeypatch.setattr("train.summary_writer", lambda folder: writer)
    args = argparse.Namespace(sh_degree=3, source_path="/s", model_path="", images="images", resolution=-1,
                              white_background=True, data_device="cuda", eval=True, **options)  # fmt: skip
    assert train.prepare_output_and_logger(args) is writer
    assert args.model_path == "./output/a_long_job"
    stored = read_stored_options(args.model_path)
    assert stored["white_background"] and stored["source_path"] == "/s" and stored["train_test_exp"] is False
    for name in ("seed", "antialiasing"):
        assert stored.get(name) == options.get(name)
    args.model_path = "out"
    train.prepare_output_and_logger(args, seed=7)
    assert read_stored_options("out")["seed"] == 7


def test_training_is_called_as_the_references(colmap_scene, tmp_path):
    """Iterations by position; further options by the names of the command line, and no others."""
    out = tmp_path / "out"
    words = ["-s", str(colmap_scene), "-m", str(out), "--iterations", "3", "-r", "24", "--eval"]
    _, dataset, opt, pipe = train.parse(words)
    with pytest.raises(TypeError, match="no option --record_curve"):
        train.training(dataset, opt, pipe, [], [], [], None, record_curve=False)
    assert not out.exists()
    train.training(dataset, opt, pipe, [-1], [2, 3], [2], None, -1, no_curve=True)
    saved = {path.name for path in out.glob("point_cloud/*")} | {path.name for path in out.glob("*.pth")}
    assert saved == {"iteration_2", "iteration_3", "chkpnt2.pth"}
    assert not (out / "error_vs_time.csv").exists() and not (out / "exposure.json").exists()


def test_minus_one_saves_the_last_iteration_only(colmap_scene, tmp_path):
    words = "--save_iterations", -1, "--checkpoint_iterations", -1, "--no_last_checkpoint"
    _train(colmap_scene, tmp_path, *words, iterations=2)
    assert [path.name for path in (tmp_path / "point_cloud").iterdir()] == ["iteration_2"]
    assert not list(tmp_path.glob("*.pth"))
