"""Trainings that --resume continues, and what a finished one leaves."""

import json
import re
import sys
from pathlib import Path

import pytest
from trainings import train_on

from arguments.launch import launch_options
from groundwork.files.json_files import read_model_json
from scene.gaussians.checkpoint import load_checkpoint
from splatting import resume
from splatting.folder import REPLACED, new_folder
from splatting.resume import read_end
from utils.system_utils import UserError

WORDS = ("-r", 24, "--no_curve", "--disable_viewer", "--test_iterations", -1)
GROWING = ("--densify_from_iter", 5, "--densification_interval", 10, "--opacity_reset_interval", 25)


@pytest.fixture(autouse=True)
def own_streams(monkeypatch):
    monkeypatch.setattr(sys, "stdout", sys.stdout)  # training stamps it


def _checkpoints(folder: Path) -> set[str]:
    return {path.name for path in folder.glob("*.pth")}


def _train(scene: Path, out: Path, iterations: int, *words: object) -> bytes:
    return train_on(scene, out, *WORDS, *GROWING, "--iterations", iterations, *words)[iterations]


class Killed(BaseException):
    """Ends a training as a signal would that nobody catches."""


def _killed(monkeypatch: pytest.MonkeyPatch, iteration: int) -> None:
    """Let a training end in an iteration, at once."""
    stepped = resume.Resume.stepped

    def kill(self: resume.Resume, at: object) -> None:
        stepped(self, at)
        if at.iteration == iteration:
            raise Killed

    monkeypatch.setattr(resume.Resume, "stepped", kill)


def test_resumed_to_the_same_bytes_by_the_same_command(colmap_scene, tmp_path, monkeypatch, capfd):
    whole = _train(colmap_scene, tmp_path / "whole", 40)
    out = tmp_path / "out"
    monkeypatch.setattr(resume, "LEAST", 0.0)
    monkeypatch.setattr(resume, "SHARE", float("inf"))
    monkeypatch.setattr(resume, "EVERY", 10)
    for iteration, newest in ((7, None), (14, 10), (39, 30)):
        with monkeypatch.context() as patch, pytest.raises(Killed):
            _killed(patch, iteration)
            _train(colmap_scene, out, 40, "--resume")
        assert _checkpoints(out) == ({REPLACED} if newest else set())
        assert newest is None or load_checkpoint(out / REPLACED)[1] == newest
        assert read_end(out) is None
    assert _train(colmap_scene, out, 40, "--resume") == whole
    assert _checkpoints(out) == {"chkpnt40.pth"} and read_end(out).iteration == 40
    said = rf"^Last checkpoint: {out}/chkpnt40.pth \(1.\d+ MB\); --resume with more --iterations cont"
    assert re.search(said, capfd.readouterr().out, re.MULTILINE)
    before = (out / "cfg_args").stat().st_mtime_ns
    for name in (".train.lock", REPLACED):  # as of a training that was killed between its note and its end
        (out / name).touch()
    assert _train(colmap_scene, out, 40, "--resume") == whole and (out / "cfg_args").stat().st_mtime_ns == before
    assert _checkpoints(out) == {"chkpnt40.pth"} and not (out / ".train.lock").exists()
    assert "has a finished training of 40 iterations; more --iterations continues it" in capfd.readouterr().out


def test_a_model_alone_is_no_end(colmap_scene, tmp_path, monkeypatch):
    """A training that is killed after its last save goes through its end again."""
    with monkeypatch.context() as patch, pytest.raises(Killed):
        _killed(patch, 12)
        _train(colmap_scene, tmp_path, 12, "--resume")
    assert _checkpoints(tmp_path) == {"chkpnt12.pth"} and read_end(tmp_path) is None
    _train(colmap_scene, tmp_path, 12, "--resume")
    assert read_end(tmp_path).iteration == 12


def test_more_iterations_continue_a_finished_training(colmap_scene, tmp_path, capfd):
    _train(colmap_scene, tmp_path, 12)
    _train(colmap_scene, tmp_path, 20, "--resume")
    assert f"Resuming {tmp_path} at iteration 12" in (said := capfd.readouterr()).out
    assert _checkpoints(tmp_path) == {"chkpnt12.pth", "chkpnt20.pth"} and read_end(tmp_path).iteration == 20
    assert "starts over" not in said.err
    (tmp_path / REPLACED).write_bytes(b"of another training")
    _train(colmap_scene, tmp_path, 20)
    said = f"warning: {tmp_path} has a finished training of 20 iterations, and this one starts over; --resume with more"
    assert said in capfd.readouterr().err and not (tmp_path / REPLACED).exists()


def test_a_finished_training_without_its_last_checkpoint_is_not_said_to_continue(colmap_scene, tmp_path, capfd):
    """Whose checkpoint of another iteration, as of Ctrl-C, is not its end."""
    _train(colmap_scene, tmp_path, 12, "--no_last_checkpoint", "--checkpoint_iterations", 5)
    assert _checkpoints(tmp_path) == {"chkpnt5.pth"} and read_model_json(tmp_path)["finished"] == 12
    assert "Last checkpoint" not in capfd.readouterr().out
    assert launch_options().no_last_checkpoint  # as a call of the reference's `training` leaves none
    _train(colmap_scene, tmp_path, 12, "--resume")
    assert "has a finished training of 12 iterations and no checkpoint of its end" in capfd.readouterr().out
    for more in ((20,), (12, "--time_budget", 1)):
        with pytest.raises(UserError, match="of 12 iterations, which left no checkpoint to continue; leave --resume"):
            _train(colmap_scene, tmp_path, *more, "--resume")
    _train(colmap_scene, tmp_path, 20)
    assert "of 12 iterations, and this one starts over\n" in capfd.readouterr().err


def test_a_model_of_which_nobody_knows_that_it_is_unfinished_is_not_replaced(colmap_scene, tmp_path):
    """The model is one of the reference, or has a damaged file."""
    _train(colmap_scene, tmp_path, 5, "--no_last_checkpoint")
    (tmp_path / "model.json").unlink()
    for said in ("has a model, and no checkpoint to continue", "model.json"):
        with pytest.raises(UserError, match=said):
            _train(colmap_scene, tmp_path, 9, "--resume")
        (tmp_path / "model.json").write_text("{")


def test_a_training_of_another_length_leaves_a_checkpoint_that_seconds_continue(colmap_scene, tmp_path, capfd):
    words = *WORDS, "--iterations", 20
    train_on(colmap_scene, tmp_path, *words, "--schedule", 12)
    assert _checkpoints(tmp_path) == {"chkpnt12.pth"} and read_end(tmp_path).iteration == 12
    train_on(colmap_scene, tmp_path, *words, "--schedule", 12, "--resume")
    assert "of 12 iterations; --time_budget SECONDS continues it" in capfd.readouterr().out
    with pytest.raises(UserError, match="of 12 iterations; give --resume with --time_budget SECONDS to continue it"):
        _train(colmap_scene, tmp_path, 40, "--resume")


def test_the_newest_whole_checkpoint_is_resumed(colmap_scene, tmp_path, capfd):
    """Not a folder, a link to nothing, or half a file."""
    _train(colmap_scene, tmp_path, 20, "--checkpoint_iterations", 8, "--no_last_checkpoint")
    (tmp_path / "model.json").write_text(json.dumps(read_model_json(tmp_path) | {"finished": None}))
    (tmp_path / "chkpnt9.pth").mkdir()
    (tmp_path / "chkpnt10.pth").symlink_to(tmp_path / "nothing")
    (tmp_path / "chkpnt11.pth").write_bytes((tmp_path / "chkpnt8.pth").read_bytes()[:-999])
    _train(colmap_scene, tmp_path, 20, "--resume")
    assert f"Resuming {tmp_path} at iteration 8" in capfd.readouterr().out


def test_a_full_disk_ends_no_training(colmap_scene, tmp_path, capfd):
    (tmp_path / "chkpnt12.pth").mkdir()  # which cannot be replaced by a file
    _train(colmap_scene, tmp_path, 12)
    assert f"warning: cannot write {tmp_path / 'chkpnt12.pth'}" in capfd.readouterr().err
    assert read_end(tmp_path).iteration == 12


def test_new_folders_are_named_after_the_scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("OAR_JOB_ID", raising=False)
    (tmp_path / "garden").mkdir()
    for name in ("garden", "garden_2", "garden_3"):
        assert new_folder("garden/") == f"./output/{name}"
        (tmp_path / "output" / name).mkdir(parents=True)
    assert new_folder() == f"./output/{tmp_path.name}"
