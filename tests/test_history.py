"""Trainings after others: into a folder with a model, from elsewhere, with other options; and the folder's lock."""

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from synthetic import folder_state
from test_arguments import MODEL
from waiting import wait_for

import train
from arguments import add_to_model_json, read_model_json, write_cfg_args
from groundwork.files.folders import remove_temporary_files
from splatting.folder import continue_records, own_folder, records_kept, refuse_other_scene
from splatting.records.error_curve import COLUMNS, read_curve, write_curve
from utils.system_utils import UserError, atomic_write

CURVE, LOG = "error_vs_time.csv", "train_log.json"


def _train(scene: Path, out: Path, *more: object, iterations: int) -> bytes:
    words = ["-s", scene, "-m", out, "-r", 48, "--iterations", iterations, "--test_iterations", -1, *more]
    words.append("--disable_viewer")  # its port may be in use, which is a warning
    train.main(list(map(str, words)))
    return (out / "point_cloud" / f"iteration_{iterations}" / "point_cloud.ply").read_bytes()


def _warnings(text: str) -> list[str]:
    return re.findall("^warning: .*$", text, re.MULTILINE)


# Into a folder with a model


def test_a_model_of_another_scene_is_refused_and_nothing_of_it_changes(colmap_scene, blender_scene, tmp_path, capfd):
    out = tmp_path / "out"
    _train(colmap_scene, out, "--checkpoint_iterations", 2, iterations=3)
    before = folder_state(out)
    for options in ([], ["--start_checkpoint", _elsewhere(out / "chkpnt2.pth", tmp_path)]):
        with pytest.raises(UserError, match=rf"out holds a model of another scene, {colmap_scene}; name another"):
            _train(blender_scene, out, *options, iterations=4)
        assert "holds a training" not in capfd.readouterr().err  # as it is refused
        assert folder_state(out) == before


def _elsewhere(checkpoint: Path, folder: Path) -> Path:
    """A copy of the checkpoint with nothing beside it."""
    (folder / "moved").mkdir(exist_ok=True)
    return Path(shutil.copy(checkpoint, folder / "moved"))


def test_iterations_that_stay_are_warned_of(colmap_scene, tmp_path, capfd):
    out = tmp_path / "out"
    _train(colmap_scene, out, "--save_iterations", 1, 3, iterations=5)
    # 30000, a default of --save_iterations, is not reached, so it is not overwritten.
    (out / "point_cloud" / "iteration_30000").mkdir()
    (out / "point_cloud" / "iteration_30000" / "point_cloud.ply").touch()
    capfd.readouterr()
    _train(colmap_scene, out, "--save_iterations", 1, 30000, "--checkpoint_iterations", 3, iterations=4)
    warning, finished = _warnings(capfd.readouterr().err)
    assert "of 5 iterations, and this one starts over" in finished
    assert "keeps iteration 3, 5, 30000 of an earlier training; this one starts over" in warning
    # Files that a resumed run saved before do not belong to another training.
    _train(colmap_scene, out, "--start_checkpoint", out / "chkpnt3.pth", iterations=6)
    (warning,) = _warnings(capfd.readouterr().err)
    assert "keeps iteration 4, 5, 30000 of" in warning


def test_a_longer_model_keeps_the_options_that_it_was_trained_with(colmap_scene, tmp_path):
    out = tmp_path / "out"
    _train(colmap_scene, out, "--eval", "--checkpoint_iterations", 2, iterations=4)
    before = folder_state(out)
    for start in ([], ["--start_checkpoint", out / "chkpnt2.pth"]):
        with pytest.raises(UserError, match="keeps iteration .*4 of .* with --eval, and this one has no --eval"):
            _train(colmap_scene, out, *start, iterations=3)
        assert folder_state(out) == before
    _train(colmap_scene, out, iterations=4)  # is the one that commands take


# From a checkpoint elsewhere


@pytest.fixture(scope="module")
def _whole_master(_colmap_master, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdout", sys.stdout)  # training stamps it
        words = "--eval", "--test_iterations", 10, 30, "--checkpoint_iterations", 20
        _train(_colmap_master, out, *words, iterations=40)
    return out


@pytest.fixture
def whole(_whole_master, _colmap_master, colmap_scene, tmp_path) -> Path:
    """A model folder with a curve, and a checkpoint at 20 of 40, as of a training on colmap_scene."""
    out = Path(shutil.copytree(_whole_master, tmp_path / "whole"))
    options = (out / "cfg_args").read_text()
    (out / "cfg_args").write_text(options.replace(str(_colmap_master), str(colmap_scene)))
    return out


def test_log_and_curve_go_on_in_another_folder(whole, colmap_scene, tmp_path, capfd):
    new, before = tmp_path / "new", folder_state(whole)
    new.mkdir()
    (new / CURVE).write_text("of an earlier attempt")
    (new / LOG).write_text("[]")
    capfd.readouterr()
    same = _train(
        colmap_scene, new, "--eval", "--test_iterations", 10, 30, "--start_checkpoint", whole / "chkpnt20.pth",
        iterations=40,
    )  # fmt: skip
    assert same == (whole / "point_cloud/iteration_40/point_cloud.ply").read_bytes()
    assert folder_state(whole) == before and _warnings(capfd.readouterr().err) == []
    rows, old = read_curve(new / CURVE), read_curve(whole / CURVE)
    kept = [row for row in old if row["iteration"] <= 20]
    assert kept and rows[: len(kept)] == kept and rows[-1]["iteration"] == 40
    log, old_log = (json.loads((folder / LOG).read_text()) for folder in (new, whole))
    assert log[:2] == [record for record in old_log if record["iteration"] <= 20]
    assert [record["iteration"] for record in log] == [10, 20, 30, 40]
    seconds = [row["seconds"] for row in rows]
    assert seconds == sorted(seconds) and seconds[len(kept)] > log[1]["seconds"]


def test_a_checkpoint_alone_counts_from_zero_and_says_so(whole, colmap_scene, tmp_path, capfd):
    alone = _elsewhere(whole / "chkpnt20.pth", tmp_path)
    _train(colmap_scene, tmp_path / "new", "--eval", "--start_checkpoint", alone, iterations=40)
    said = capfd.readouterr().err
    assert f"{LOG} beside {alone} has no records up to iteration 20" in said
    assert all(row["iteration"] > 20 for row in read_curve(tmp_path / "new" / CURVE))
    # The folder that the checkpoint was taken from has the log.
    _train(colmap_scene, whole, "--eval", "--start_checkpoint", alone, iterations=40)
    assert "train_log.json beside" not in capfd.readouterr().err
    assert read_curve(whole / CURVE)[0]["iteration"] < 20


def test_seconds_go_on_from_whichever_is_later_log_or_curve(tmp_path, capsys):
    """An interrupted training has rows after its log's last record, and a log may be lost."""
    row = dict.fromkeys(COLUMNS) | {"iteration": 8, "seconds": 80.0, "wall_seconds": None}
    write_curve(tmp_path / CURVE, [row])
    for records, seconds, wall in (
        ([{"iteration": 7, "seconds": 70.0, "wall_seconds": 71.0}], 80.0, 71.0),
        ([{"iteration": 7, "seconds": 90.0, "wall_seconds": 91.0}], 90.0, 91.0),
        (None, 80.0, 0.0),
    ):
        (tmp_path / LOG).unlink(missing_ok=True)
        if records:
            (tmp_path / LOG).write_text(json.dumps(records))
        log, rows = continue_records(str(tmp_path), str(tmp_path / "chkpnt9.pth"), 9)
        assert (log.seconds_before, log.wall_seconds_before, rows) == (seconds, wall, [row])
    assert capsys.readouterr().err == ""
    log, rows = continue_records(str(tmp_path), None, 0)
    assert (log.seconds_before, rows) == (0.0, [])


# With other options


def test_changed_options_are_told_in_one_line(colmap_scene, tmp_path, capfd):
    out = tmp_path / "out"
    (colmap_scene / "masks").mkdir()
    _train(colmap_scene, out, "--checkpoint_iterations", 2, "--seed", 3, iterations=3)
    assert read_model_json(out)["optimizer_type"] == "default"
    options = ["--start_checkpoint", out / "chkpnt2.pth", "--seed", 3]
    _train(colmap_scene, tmp_path / "same", *options, iterations=3)
    assert _warnings(capfd.readouterr().err) == []
    changed = ["-r", 72, "-w", "--antialiasing", "--optimizer_type", "sparse_adam", "--mask_meaning",
               "transparent", "--seed", 4, "--lambda_dssim", 0.4]  # fmt: skip
    _train(colmap_scene, tmp_path / "changed", *options, *changed, iterations=3)
    (warning,) = _warnings(capfd.readouterr().err)
    before, _, now = warning.partition(", this run has ")
    assert "trained with --resolution 48 no --white_background --mask_meaning auto no --antialiasing" in before
    assert now.split()[:3] == ["--resolution", "72", "--white_background"] and now.endswith("sparse_adam --seed 4")
    # In the same folder cfg_args is overwritten, so the message must come before.
    _train(colmap_scene, out, *options, "-w", iterations=3)
    assert len(_warnings(capfd.readouterr().err)) == 1


def test_a_training_that_cannot_go_on_rightly_is_not_resumed(colmap_scene, tmp_path, capfd):
    out = tmp_path / "out"
    _train(colmap_scene, out, "--checkpoint_iterations", 2, iterations=3)
    with pytest.raises(UserError, match="was trained on all photos, so --eval has no unseen photos to hold out"):
        _train(colmap_scene, tmp_path / "new", "--eval", "--start_checkpoint", out / "chkpnt2.pth", iterations=3)
    for gone, said in (
        ({"resolution_schedule": "pyramid"}, "--resolution_schedule pyramid"),
        ({"options": {"region": "auto"}}, "--region auto"),
    ):
        add_to_model_json(out, **gone)
        with pytest.raises(UserError, match=f"chkpnt2.pth was trained with {said}, which this code does not have"):
            _train(colmap_scene, tmp_path / "new", "--start_checkpoint", out / "chkpnt2.pth", iterations=3)
    assert not (tmp_path / "new").exists()


def test_a_checkpoint_of_another_scene_is_refused_and_one_of_a_moved_scene_told(whole, colmap_scene, tmp_path, capfd):
    other = shutil.copytree(colmap_scene, tmp_path / "other")
    start = "--eval", "--start_checkpoint", whole / "chkpnt20.pth"
    with pytest.raises(UserError, match=f"chkpnt20.pth is of another scene, {colmap_scene}; resume it with that one"):
        _train(other, tmp_path / "new", *start, iterations=40)
    moved = colmap_scene.rename(tmp_path / "moved_scene")
    capfd.readouterr()
    _train(moved, whole, *start, iterations=40)
    (warning,) = _warnings(capfd.readouterr().err)
    assert f"trained with --source_path {colmap_scene}, this run has --source_path {moved}" in warning


# The output folder: one train.py at a time, no leftovers of killed runs, a word about removed files


def test_a_second_training_is_refused_and_a_killed_one_blocks_nothing(tmp_path):
    holder = os.fork()
    if not holder:
        with own_folder(str(tmp_path)):
            (tmp_path / "held").touch()
            time.sleep(600)
    try:
        wait_for((tmp_path / "held").exists)
        said = rf"another train.py \(process {holder}\) is running in .*another -m"
        with pytest.raises(UserError, match=said), own_folder(str(tmp_path)):
            pass
    finally:
        os.kill(holder, signal.SIGKILL)
        os.waitpid(holder, 0)
    (tmp_path / "held").unlink()
    assert (tmp_path / ".train.lock").exists()
    with own_folder(str(tmp_path)):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("error", [UserError, KeyboardInterrupt, SystemExit])
def test_every_ending_releases_the_folder(tmp_path, error):
    with pytest.raises(error), own_folder(str(tmp_path)):
        raise error
    assert not list(tmp_path.iterdir())


def test_temporary_files_of_dead_processes_are_removed(tmp_path):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    living = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    inner = tmp_path / "point_cloud" / "iteration_7"
    inner.mkdir(parents=True)
    gone = [tmp_path / f".chkpnt200.{dead.pid}.tmp.pth", inner / f".point_cloud.{dead.pid}.tmp.ply"]
    gone.append(tmp_path / f".cfg_args.{dead.pid}.tmp")
    stay = [tmp_path / f".model.{living.pid}.tmp.json", tmp_path / "chkpnt200.pth", tmp_path / ".a.x.tmp.pth"]
    try:
        for path in (*gone, *stay):
            path.touch()
        with own_folder(str(tmp_path)):
            assert not any(path.exists() for path in gone)
        assert all(path.exists() for path in stay)
    finally:
        living.kill()
        living.wait()


@pytest.mark.parametrize("name", ["chkpnt7.pth", "cfg_args", "a.b.png", "point_cloud.ply", ".hidden"])
def test_the_names_of_temporary_files_are_known(tmp_path, monkeypatch, name):
    with atomic_write(tmp_path / name) as temporary:
        temporary.touch()
        assert not remove_temporary_files(tmp_path)  # this process lives
        monkeypatch.setattr("groundwork.files.folders._is_running", lambda process: process != os.getpid())
        assert remove_temporary_files(tmp_path) == [temporary]
        temporary.touch()


def test_a_folder_that_is_removed_while_training_is_told_of(tmp_path, capsys):
    folder = tmp_path / "out"
    with own_folder(str(folder)):
        shutil.rmtree(folder)
        folder.mkdir()
        (folder / "cfg_args").touch()
    assert "warning: model.json, cameras.json, input.ply in" in (said := capsys.readouterr().err)
    assert "were removed during training" in said


@pytest.mark.parametrize("saves", [False, True])
def test_records_stay_with_the_model_that_is_saved(tmp_path, saves):
    ply = tmp_path / "point_cloud" / "iteration_7" / "point_cloud.ply"
    for path in (ply, tmp_path / "cfg_args"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("old")
    with pytest.raises(ValueError, match="odd"), records_kept(str(tmp_path)):
        (tmp_path / "cfg_args").write_text("new")
        if saves:
            ply.with_name("point_cloud.ply").unlink()
            (tmp_path / "chkpnt3.pth").touch()
        raise ValueError("odd")
    assert (tmp_path / "cfg_args").read_text() == ("new" if saves else "old")


@pytest.mark.parametrize("trained", ["chkpnt5.pth", "point_cloud/iteration_5/point_cloud.ply"])
def test_what_a_folder_must_hold_to_be_refused(tmp_path, trained):
    """Write a trained model and a cfg_args that names another scene."""

    def check(source: Path, checkpoint: Path | None = None) -> None:
        options = MODEL | {"source_path": str(source), "model_path": str(tmp_path)}
        refuse_other_scene(argparse.Namespace(**options), checkpoint and str(checkpoint))

    scene, other = tmp_path / "scene", tmp_path / "other"
    scene.mkdir()
    write_cfg_args(tmp_path, argparse.Namespace(**MODEL | {"source_path": str(scene)}))
    check(other)
    (tmp_path / trained).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / trained).touch()
    with pytest.raises(UserError, match=f"holds a model of another scene, {scene}"):
        check(other)
    check(scene / ".." / "scene")
    # Resuming in the same folder is report_changes' to judge.
    check(other, tmp_path / "chkpnt5.pth")
    scene.rename(tmp_path / "moved")
    check(tmp_path / "moved")
    (tmp_path / "cfg_args").write_text("of another program")
    check(other)
