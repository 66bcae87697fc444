"""The last save of a training: it leaves out Gaussians that no training view depends on, and SH bands on request."""

import argparse
import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gaussians import model, parameters, pipeline
from plyfile import PlyData

import render as render_script
import train
from arguments import ModelParams, read_cfg_args
from diagnosis.model import check_model
from gaussian_renderer import render
from gaussian_renderer.scored_views import ScoredViews
from gaussian_renderer.trimming import change_on_views, decisive_for_any, trim
from scene import Scene
from scene.gaussian_model import GaussianModel
from scene.gaussians.checkpoint import load_checkpoint
from scene.readers.point_cloud import write_point_cloud
from training.left_out import LeftOut, lines
from utils.system_utils import UserError

ITERATIONS = 12
BLACK = torch.zeros(3)


def _train(scene: Path, out: Path, cloud: Path, *more: object) -> None:
    options = ["--eval", "-r", 48, "--iterations", ITERATIONS, "--no_curve", "--init_pcd_path", cloud, *more]
    train.main(["-s", str(scene), "-m", str(out), *map(str, options)])


def _ply(out: Path, iteration: int = ITERATIONS) -> np.ndarray:
    return PlyData.read(out / f"point_cloud/iteration_{iteration}/point_cloud.ply")["vertex"].data


def _load(out: Path) -> tuple[Scene, GaussianModel]:
    """Render as render.py does."""
    options = argparse.Namespace(**read_cfg_args(out) | {"model_path": str(out)})
    gaussians = GaussianModel(options.sh_degree)
    options = ModelParams(argparse.ArgumentParser()).extract(options)
    return Scene(options, gaussians, load_iteration=-1, shuffle=False), gaussians


def _image(camera, gaussians: GaussianModel) -> torch.Tensor:
    return render(camera, gaussians, pipeline(), BLACK, want_visibility=False)["render"]


@pytest.fixture(scope="module")
def runs(_colmap_master, tmp_path_factory) -> SimpleNamespace:
    """Trainings with and without --keep_unseen, with cut bands, and with the half-image protocol."""
    folder = tmp_path_factory.mktemp("trimming")
    cloud = folder / "cloud.ply"
    rng = np.random.default_rng(2)
    # Half of the points are in close groups far away, so small that many are outside every training view.
    groups = np.repeat(rng.normal(size=(60, 3)) * 12, 5, axis=0)
    points = np.concatenate([rng.normal(size=(300, 3)) * 0.4, groups + 0.05 * rng.normal(size=(300, 3))])
    write_point_cloud(cloud, points, rng.integers(0, 256, (600, 3)))
    stdout = sys.stdout
    try:
        scene, often = _colmap_master, ("--save_iterations", 5, "--checkpoint_iterations", ITERATIONS)
        _train(scene, folder / "trimmed", cloud, *often, "--test_iterations", ITERATIONS)
        _train(scene, folder / "whole", cloud, *often, "--test_iterations", -1, "--keep_unseen")
        _train(scene, folder / "cut", cloud, "--save_iterations", 5, "--test_iterations", -1, "--prune_sh", 0)
        _train(scene, folder / "halves", cloud, "--test_iterations", ITERATIONS, "--train_test_exp")
    finally:
        sys.stdout = stdout  # restore it, since training stamps it
    return SimpleNamespace(**{name: folder / name for name in ("trimmed", "whole", "cut", "halves")})


def test_only_rows_that_no_training_view_depends_on_are_missing(runs):
    scene, whole = _load(runs.whole)
    seen = decisive_for_any(scene.getTrainCameras(), whole, pipeline()).numpy()
    assert 400 < seen.sum() < 580
    np.testing.assert_array_equal(_ply(runs.trimmed), _ply(runs.whole)[seen])
    assert len(_ply(runs.whole)) == 600


def test_training_views_are_the_same_to_the_bit(runs):
    scene, whole = _load(runs.whole)
    trimmed = _load(runs.trimmed)[1]
    changed = [not torch.equal(_image(c, whole), _image(c, trimmed)) for c in scene.getTestCameras()]
    assert any(changed)  # so other views do see some of them
    for camera in scene.getTrainCameras():
        assert torch.equal(_image(camera, whole), _image(camera, trimmed))


def test_earlier_saves_and_checkpoints_have_all(runs):
    assert len(_ply(runs.trimmed, 5)) == 600
    capture, _ = load_checkpoint(runs.trimmed / f"chkpnt{ITERATIONS}.pth")
    assert len(capture[1]) == 600
    other, _ = load_checkpoint(runs.whole / f"chkpnt{ITERATIONS}.pth")
    assert all(torch.equal(a, b) for a, b in zip(capture[1:7], other[1:7], strict=True))


def test_what_is_reported(runs):
    record = json.loads((runs.trimmed / "model.json").read_text())["left_out"]
    missing = 600 - len(_ply(runs.trimmed))
    assert record["unseen"] == missing and record["gaussians"] == 600
    assert record["ply_bytes_saved"] == missing * 62 * 4
    assert record["sh_degree"] == record["max_sh_degree"] == 3 and record["cut_bounds"] == [0, 0, 0, 0]
    log = json.loads((runs.trimmed / "train_log.json").read_text())[-1]
    assert log["gaussians_left_out"] == missing and log["gaussians"] == 600
    # The change on test views, with the test images as they were scored at this iteration.
    scene, whole = _load(runs.whole)
    change = change_on_views(
        whole, _load(runs.trimmed)[1], scene.getTestCameras(), ScoredViews(pipeline(), BLACK, False), scored=True
    )
    assert record["test_change"] == pytest.approx(change) and set(change) == {"largest", "psnr_before", "psnr_after"}
    assert change["largest"] > 0
    kept = json.loads((runs.whole / "model.json").read_text())["left_out"]
    assert kept["unseen"] == 0 and kept["keep_unseen"] and kept["test_change"] == {}


def test_bands_that_are_zero_are_cut_and_the_model_is_read_again(runs):
    assert read_cfg_args(runs.cut)["sh_degree"] == 0  # nothing was trained above it yet
    assert len(_ply(runs.cut).dtype) == 62 - 45
    scene, cut = _load(runs.cut)
    trimmed = _load(runs.trimmed)[1]
    for camera in scene.getTrainCameras() + scene.getTestCameras():
        assert torch.equal(_image(camera, cut), _image(camera, trimmed))
    record = json.loads((runs.cut / "model.json").read_text())["left_out"]
    assert record["sh_degree"] == 0
    # No test photo was used before, so none is decoded for a score.
    assert set(record["test_change"]) == {"largest"}


def test_saves_before_the_cut_are_read_with_the_bands_they_have(runs, monkeypatch):
    monkeypatch.setattr(sys, "stdout", sys.stdout)

    def render_iteration(*options: object) -> None:
        command = ["render.py", "-m", runs.cut, "--skip_train", "--quiet", "--iteration", *options]
        monkeypatch.setattr(sys, "argv", list(map(str, command)))
        render_script.main()

    for iteration, degree in ((5, 3), (ITERATIONS, 0)):
        render_iteration(iteration)
        assert len(list((runs.cut / "test" / f"ours_{iteration}" / "renders").glob("*.png"))) == 3
        assert check_model(str(runs.cut), iteration)[0].text.endswith(f"of SH degree {degree}")
    with pytest.raises(UserError, match="SH degree 3, but SH degree 1 needs 9"):
        render_iteration(5, "--sh_degree", 1)


def test_test_views_that_train_in_half_stay_the_same_in_whole(runs):
    record = json.loads((runs.halves / "model.json").read_text())["left_out"]
    assert record["unseen"] == 600 - len(_ply(runs.halves)) > 20
    assert record["test_change"]["largest"] == 0
    assert record["test_change"]["psnr_before"] == record["test_change"]["psnr_after"] > 5
    assert (runs.halves / "exposure.json").exists()


def test_colours_move_by_no_more_than_asked(runs):
    cameras = _load(runs.whole)[0].getTrainCameras()[:3]
    gaussians = model(200, seed=4)
    with torch.no_grad():
        gaussians._features_rest *= 0.02
    before = parameters(gaussians)
    whole = trim(gaussians, cameras, pipeline(), keep_unseen=True, prune_sh=-1.0)
    assert whole.gaussians is gaussians and whole.unseen == 0
    for degree in (2, 1, 0):
        bound = whole.cut_bounds[degree]
        cut = trim(gaussians, cameras, pipeline(), keep_unseen=True, prune_sh=bound)
        assert cut.gaussians.max_sh_degree == cut.gaussians.active_sh_degree == degree
        assert cut.gaussians._features_rest.shape[1] == (degree + 1) ** 2 - 1 and len(cut.gaussians) == 200
        moved = change_on_views(gaussians, cut.gaussians, cameras, ScoredViews(pipeline(), BLACK, False), scored=False)[
            "largest"
        ]
        assert 0.05 * bound < moved <= bound
        assert trim(gaussians, cameras, pipeline(), True, 0.99 * bound).gaussians.max_sh_degree > degree
    assert all(torch.equal(values, before[name]) for name, values in parameters(gaussians).items())


def test_a_model_that_no_view_sees_is_kept(runs):
    cameras = _load(runs.whole)[0].getTrainCameras()
    gaussians = model(5)
    with torch.no_grad():
        gaussians._opacity.fill_(-50.0)
    assert trim(gaussians, cameras, pipeline(), keep_unseen=False, prune_sh=-1.0).gaussians is gaussians


@pytest.mark.parametrize("value", ["-0.5", "nan"])
def test_no_such_tolerance(value, tmp_path):
    with pytest.raises(UserError, match="prune_sh must be"):
        train.main(["-s", str(tmp_path), "-m", str(tmp_path / "out"), f"--prune_sh={value}"])


def _left_out(**changes: object) -> LeftOut:
    values = {
        "gaussians": 1000, "unseen": 50, "keep_unseen": False, "max_sh_degree": 3, "sh_degree": 3,
        "cut_bounds": [0.3, 0.2, 0.1, 0.0], "ply_bytes": 248_000, "ply_bytes_saved": 12_400, "seconds": 1.25,
        "picture_bytes": 3_000_000, "picture_bytes_in_files": 12_000_000,
        "test_change": {"largest": 0.0123, "psnr_before": 30.0, "psnr_after": 29.9},
    }  # fmt: skip
    return LeftOut(**values | changes)


def test_the_three_lines():
    said = lines(_left_out())
    assert said == [
        "Left out 50 of 1000 Gaussians (5.0 %, 0.01 MB of the PLY) that no training view depends on, found in 1.2 s; "
        "test views change by at most 0.012 (values 0 to 1), PSNR 30.000 to 29.900 dB",
        "Left out no SH bands; cutting them would move colours by at most 0.3 above degree 0, 0.2 above degree 1, "
        "0.1 above degree 2 (--prune_sh)",
        "Colours of the training photos are kept as bytes and at training size: 3.0 MB, 45.0 MB less than as float32 "
        "at the size of the files",
    ]
    # 950 Gaussians lose 12 coefficients of 3 channels, 4 bytes each.
    cut = lines(_left_out(sh_degree=1, test_change={"largest": 0.0}))
    moved = "colours move by at most 0.2 (values 0 to 1)"
    assert cut[1] == f"Left out the SH bands above degree 1 (0.14 MB of the PLY): {moved}"
    assert cut[0].endswith("; test views change by at most 0 (values 0 to 1)")
    assert lines(_left_out(keep_unseen=True, unseen=0, test_change={}))[0].startswith("Left out no Gaussians (--keep")
    assert "none above degree 0" in lines(_left_out(max_sh_degree=0, sh_degree=0, cut_bounds=[0.0]))[1]


def test_training_says_them(colmap_scene, tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(sys, "stdout", sys.stdout)
    train.main(["-s", str(colmap_scene), "-m", str(tmp_path), "-r", "24", "--iterations", "2"])
    said = re.sub(r" \[\d\d/\d\d \d\d:\d\d:\d\d\]$", "", capfd.readouterr().out, flags=re.MULTILINE).splitlines()
    expected = lines(LeftOut(**json.loads((tmp_path / "model.json").read_text())["left_out"]))
    assert said[-4:] == [*expected, "Training complete."]
    # There are 17 photos of 96 x 64, trained at 24 x 16.
    assert "size: 0.0 MB, 1.2 MB less" in expected[2]
