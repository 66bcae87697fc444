"""Models of a folder: the newest of its PLYs and checkpoints is loaded, and opened once."""

import re
import shutil
import signal
import sys
from pathlib import Path

import pytest
import torch
from gaussians import model, parameters
from trainings import before_steps, train_on

import export
import render
from groundwork.host.start import typed_command
from scene.gaussians.checkpoint import load_checkpoint, save_checkpoint, with_extra_state
from scene.saved_model import find_save, read_model
from splatting.folder import view_command
from splatting.iteration import Iteration
from utils.system_utils import UserError

PAGES = Path(__file__).parents[1] / "docs" / "api"
WORDS = ("--eval", "-r", 24, "--no_curve", "--disable_viewer", "--test_iterations", -1, "--quiet")


def _save(folder: Path, iteration: int, checkpoint: bool = False) -> None:
    gaussians = model(5, degree=2, seed=iteration)
    if checkpoint:
        save_checkpoint(folder / f"chkpnt{iteration}.pth", gaussians.capture(), iteration)
    else:
        gaussians.save_ply(folder / f"point_cloud/iteration_{iteration}/point_cloud.ply")


def test_the_newest_of_plys_and_checkpoints(tmp_path):
    with pytest.raises(UserError, match="no saved model in"):
        find_save(tmp_path, -1)
    _save(tmp_path, 30)
    _save(tmp_path, 7, checkpoint=True)
    _save(tmp_path, 30, checkpoint=True)
    assert [find_save(tmp_path, n)[1].suffix for n in (-1, 7, 30)] == [".ply", ".pth", ".ply"]
    _save(tmp_path, 200, checkpoint=True)
    (tmp_path / "chkpnt300.pth.tmp").write_bytes(b"")
    assert find_save(tmp_path, -1) == (200, tmp_path / "chkpnt200.pth")
    with pytest.raises(UserError, match="iteration 8 was never saved .*give one of 7, 30, 200"):
        find_save(tmp_path, 8)


def test_both_kinds_have_the_same_gaussians(tmp_path):
    _save(tmp_path, 7)
    _save(tmp_path, 7, checkpoint=True)
    of_ply, of_checkpoint = (
        read_model(tmp_path / name) for name in ("point_cloud/iteration_7/point_cloud.ply", "chkpnt7.pth")
    )
    for name, values in parameters(of_ply).items():
        assert torch.equal(values, parameters(of_checkpoint)[name]), name
    assert of_checkpoint.active_sh_degree == of_checkpoint.max_sh_degree == 2
    with pytest.raises(UserError, match="--sh_degree"):
        read_model(tmp_path / "chkpnt7.pth", 3)


def test_a_checkpoint_of_a_part_that_is_gone_is_not_shown_without_it(colmap_scene, tmp_path):
    """The filter of --filter_3d is in the PLY alone. Nor is such a checkpoint trained further."""
    save_checkpoint(tmp_path / "chkpnt7.pth", with_extra_state(model(5).capture(), {"filter_3d": torch.rand(5, 1)}), 7)
    for read in (read_model, lambda path: train_on(colmap_scene, tmp_path / "out", *WORDS, "--start_checkpoint", path)):
        with pytest.raises(UserError, match=r"has a state of filter_3d, which this code .* from its PLY by --init_ply"):
            read(tmp_path / "chkpnt7.pth")


@pytest.mark.parametrize("options", [("--train_test_exp",), ("--appearance", "ppisp"), ("--refine_poses",)])
def test_a_planned_checkpoint_alone_can_be_loaded(colmap_scene, tmp_path, monkeypatch, options):
    """The files of the photos are written beside the checkpoint."""

    def stop(step: Iteration) -> None:
        if step.iteration == 4:
            raise RuntimeError("killed")

    before_steps(monkeypatch, stop)
    with pytest.raises(RuntimeError, match="killed"):
        train_on(colmap_scene, tmp_path, *WORDS, *options, "--iterations", 40, "--checkpoint_iterations", 3)
    shutil.rmtree(tmp_path / "point_cloud", ignore_errors=True)
    monkeypatch.setattr(sys, "argv", ["render.py", "-m", str(tmp_path), "--quiet"])
    render.main()
    assert any((tmp_path / "test/ours_3/renders").rglob("*.png"))


def test_an_interrupted_training_can_be_looked_at(colmap_scene, tmp_path, monkeypatch, capfd):
    before_steps(monkeypatch, lambda step: step.iteration == 20 and signal.raise_signal(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        train_on(colmap_scene, tmp_path, *WORDS, "--iterations", 40)
    monkeypatch.undo()
    said = capfd.readouterr().err
    look = f"Stopped at iteration 20\nLook at the model: {typed_command('view.py')} -m {tmp_path}\n"
    assert f"{look}Resume by the same command with --start_checkpoint {tmp_path / 'chkpnt20.pth'}" in said
    path = tmp_path / "point_cloud/iteration_20/point_cloud.ply"
    assert torch.equal(read_model(path).get_xyz, load_checkpoint(tmp_path / "chkpnt20.pth")[0][1])
    shutil.rmtree(tmp_path / "point_cloud")  # as after a crash: a checkpoint alone
    for command, words in ((render, ("--skip_train",)), (export, ("--to", tmp_path / "a.splat"))):
        monkeypatch.setattr("sys.argv", ["command", "-m", str(tmp_path), "--quiet", *map(str, words)])
        command.main()
    assert list((tmp_path / "test/ours_20/renders").iterdir()) and (tmp_path / "a.splat").stat().st_size > 1000
    monkeypatch.setattr("splatting.folder.has_application", lambda name: False)
    assert view_command("out").endswith("render.py -m out")


def test_the_example_of_the_renderers_page(colmap_scene, tmp_path, monkeypatch):
    train_on(colmap_scene, tmp_path / "OUT", *WORDS, "--iterations", 3)
    (example,) = re.findall(r"```python\n(.*?)```", (PAGES / "renderer.md").read_text(encoding="utf-8"), re.DOTALL)
    monkeypatch.chdir(tmp_path)
    exec(example, names := {})
    assert names["image"].shape == (3, 16, 24) and names["image"].max() > 0.1
