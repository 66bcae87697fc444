"""The output folder of a training: one train.py at a time, no leftovers of killed runs, a word about removed files."""

import os
import shutil
import subprocess
import sys
from argparse import Namespace
from pathlib import Path

import pytest

from splatting.files.folders import locked, remove_temporary_files
from splatting.training.folder import check_folder, folder_of, own_folder, records_kept
from utils.system_utils import UserError, atomic_write

ROOT = Path(__file__).parents[1]
HOLD = (
    "import sys, time; from splatting.training.folder import own_folder\n"
    "with own_folder(sys.argv[1]):\n"
    "    print('held', flush=True); time.sleep(600)"
)


def _holder(folder: Path) -> subprocess.Popen:
    child = subprocess.Popen([sys.executable, "-c", HOLD, str(folder)], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert child.stdout.readline() == "held\n"
    return child


def test_a_second_training_is_refused_and_a_killed_one_blocks_nothing(tmp_path, capsys):
    holder = _holder(tmp_path)
    try:
        said = rf"another train.py \(process {holder.pid}\) is running in .*another -m"
        with pytest.raises(UserError, match=said), own_folder(str(tmp_path)):
            pass
    finally:
        holder.kill()
        holder.communicate()
    assert (tmp_path / ".train.lock").exists()
    with own_folder(str(tmp_path)):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("error", [UserError, KeyboardInterrupt, SystemExit])
def test_every_ending_releases_the_folder(tmp_path, error):
    with pytest.raises(error), own_folder(str(tmp_path)):
        raise error
    assert not list(tmp_path.iterdir())


def test_a_lock_whose_file_was_replaced_is_taken_anew(tmp_path, monkeypatch):
    """Its owner removes the file at its end, which may be just after we have opened it."""
    real, removed = os.path.samestat, []

    def remove_once(*stats: os.stat_result) -> bool:
        if not removed:
            removed.append(True)
            (tmp_path / ".x.lock").unlink()
            return False
        return real(*stats)

    monkeypatch.setattr("os.path.samestat", remove_once)
    with locked(tmp_path, "x.py", "another x.py (process {process})", "-m"):
        assert removed and (tmp_path / ".x.lock").read_text() == f"{os.getpid()}\n"


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
        monkeypatch.setattr("splatting.files.folders._runs", lambda process: process != os.getpid())
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


def test_points_that_were_missing_before_a_resumed_run_are_no_news(tmp_path, capsys):
    with own_folder(str(tmp_path)):
        for name in ("cfg_args", "model.json", "cameras.json"):
            (tmp_path / name).touch()
    assert capsys.readouterr().err == ""


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


def test_a_checkpoint_is_resumed_in_its_folder(tmp_path):
    assert folder_of(None) is None and folder_of(str(tmp_path / "chkpnt7.pth")) is None
    (tmp_path / "cfg_args").touch()
    assert folder_of(str(tmp_path / "chkpnt7.pth")) == str(tmp_path)


@pytest.mark.parametrize(("start", "said"), [(None, "; this one starts over and replaces iteration 30"), (7, "")])
def test_a_warning_of_what_stays_says_that_a_training_starts_over(tmp_path, capsys, start, said):
    for iteration in (30, 60):
        ply = tmp_path / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"
        ply.parent.mkdir(parents=True)
        ply.touch()
    now = Namespace(model_path=str(tmp_path), source_path="")
    check_folder(now, [30], start and str(tmp_path / f"chkpnt{start}.pth"), start or 0)
    assert f"keeps iteration 60 of an earlier training{said}, and other commands take" in capsys.readouterr().err
