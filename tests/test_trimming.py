"""The last save of a training: it leaves out Gaussians that nobody sees, and SH bands that are zero or as asked."""

import argparse
import json
import math
import sys
from itertools import chain
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gaussians import model, parameters, pipeline
from plyfile import PlyData
from scipy.spatial.transform import Rotation, Slerp

import render as render_script
import train
from applications.doctor.model import check_model
from arguments import ModelParams, read_cfg_args
from gaussian_renderer import decisive_for, render, trimming
from gaussian_renderer.free_view import FRACTIONS, NEAREST, WIDER, neighbours, views_between
from gaussian_renderer.scored_views import ScoredViews
from gaussian_renderer.trimming import DONE, FAINT, FEW, TOO_LONG, change_on_views, decisive_for_any, trim, walk_pairs
from scene import Scene
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.gaussians.checkpoint import load_checkpoint
from scene.readers.point_cloud import write_point_cloud
from utils.system_utils import UserError

ITERATIONS = 12
BLACK = torch.zeros(3)


def _train(scene: Path, out: Path, cloud: Path, *more: object) -> None:
    options = ["--eval", "-r", 48, "--iterations", ITERATIONS, "--no_curve", "--init_pcd_path", cloud, *more]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("splatting.run.SH_INTERVAL", ITERATIONS)  # no SH band is trained
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
    """Trainings with and without --keep_unseen, and with few bands.

    They are so short that the search would take too long, were it not allowed any number of views.
    """
    folder = tmp_path_factory.mktemp("trimming")
    cloud = folder / "cloud.ply"
    rng = np.random.default_rng(2)
    # Half of the points are in close groups far away, so small that many are outside every training view.
    groups = np.repeat(rng.normal(size=(60, 3)) * 12, 5, axis=0)
    points = np.concatenate([rng.normal(size=(300, 3)) * 0.4, groups + 0.05 * rng.normal(size=(300, 3))])
    write_point_cloud(cloud, points, rng.integers(0, 256, (600, 3)))
    stdout = sys.stdout
    often = ("--save_iterations", 5, "--checkpoint_iterations", 5, ITERATIONS)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trimming, "ITERATIONS_PER_VIEW", 1e-3)
        scene, all_bands = _colmap_master, ("--prune_sh", -1)
        _train(scene, folder / "trimmed", cloud, *often, *all_bands, "--test_iterations", ITERATIONS)
        _train(scene, folder / "whole", cloud, *often, *all_bands, "--test_iterations", -1, "--keep_unseen")
        _train(scene, folder / "cut", cloud, *often, "--prune_sh", 0, "--test_iterations", -1)
    sys.stdout = stdout  # restore it, since training stamps it
    return SimpleNamespace(**{name: folder / name for name in ("trimmed", "whole", "cut")})


@pytest.fixture(scope="module")
def cameras(runs) -> list[Camera]:
    return _load(runs.whole)[0].getTrainCameras()


def _walked(scene: Scene) -> list:
    """Views between neighbouring training cameras."""
    cameras = scene.getTrainCameras()
    return list(chain.from_iterable(views_between(cameras[i], cameras[j]) for i, j in neighbours(cameras)))


def test_only_rows_that_neither_training_views_nor_those_between_depend_on_are_missing(runs):
    scene, whole = _load(runs.whole)
    photographed = decisive_for_any(scene.getTrainCameras(), whole, pipeline()).numpy()
    seen = photographed | decisive_for_any(_walked(scene), whole, pipeline()).numpy()
    assert 400 < photographed.sum() < seen.sum() < 580  # so views between see some that no photo shows
    np.testing.assert_array_equal(_ply(runs.trimmed), _ply(runs.whole)[seen])
    assert len(_ply(runs.whole)) == 600


def test_training_views_and_a_walk_between_neighbours_are_the_same_to_the_bit(runs):
    scene, whole = _load(runs.whole)
    trimmed = _load(runs.trimmed)[1]
    for camera in scene.getTrainCameras() + _walked(scene)[::5]:
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
    assert record["search"] == DONE and record["faint"] == 0
    assert record["views"] == len(_load(runs.whole)[0].getTrainCameras()) + len(_walked(_load(runs.whole)[0]))
    # The change on test views, with the test images as they were scored at this iteration.
    scene, whole = _load(runs.whole)
    change = change_on_views(
        whole, _load(runs.trimmed)[1], scene.getTestCameras(), ScoredViews(pipeline(), BLACK, False), scored=True
    )
    assert record["test_change"] == pytest.approx(change) and set(change) == {"largest", "psnr_before", "psnr_after"}
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
    assert record["ply_bytes_saved"] == 600 * 62 * 4 - len(_ply(runs.cut)) * 17 * 4
    # No test photo was used before, so none is decoded for a score.
    assert set(record["test_change"]) == {"largest"}


def test_a_resumed_training_has_the_bands_that_the_last_save_left_out(runs, _colmap_master, tmp_path, monkeypatch):
    monkeypatch.setattr(trimming, "ITERATIONS_PER_VIEW", 1e-3)
    cloud = runs.cut.parent / "cloud.ply"
    for degree, again in ((), runs.trimmed), (("--prune_sh", 0), runs.cut):
        checkpoint = ("--start_checkpoint", runs.cut / "chkpnt5.pth")
        _train(_colmap_master, tmp_path, cloud, *degree, *checkpoint, "--test_iterations", -1)
        np.testing.assert_array_equal(_ply(tmp_path), _ply(again))


def test_without_options_a_short_training_saves_all_it_drew(runs, _colmap_master, tmp_path, monkeypatch):
    """Its search would take too long; readers of others count on the columns of the requested degree, 3."""
    _train(_colmap_master, tmp_path, runs.cut.parent / "cloud.ply", "--test_iterations", -1)
    assert len(_ply(tmp_path)) == 600 and len(_ply(tmp_path).dtype) == 62
    record = json.loads((tmp_path / "model.json").read_text())["left_out"]
    assert record["search"] == TOO_LONG and record["views"] > len(_load(tmp_path)[0].getTrainCameras())


def test_saves_before_the_cut_are_read_with_the_bands_they_have(runs, monkeypatch):

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


def test_colours_move_by_no_more_than_asked(cameras):
    cameras = cameras[:3]
    gaussians = model(200, seed=4)
    with torch.no_grad():
        gaussians._features_rest *= 0.02
    before = parameters(gaussians)
    whole, search = trim(gaussians, cameras, pipeline(), keep_unseen=True, prune_sh=-1.0, iterations=1)
    assert whole is gaussians and search.unseen == 0
    for degree in (2, 1, 0):
        bound = search.cut_bounds[degree]
        cut, _ = trim(gaussians, cameras, pipeline(), keep_unseen=True, prune_sh=bound, iterations=1)
        assert cut.max_sh_degree == cut.active_sh_degree == degree
        assert cut._features_rest.shape[1] == (degree + 1) ** 2 - 1 and len(cut) == 200
        moved = change_on_views(gaussians, cut, cameras, ScoredViews(pipeline(), BLACK, False), scored=False)
        assert 0.05 * bound < moved["largest"] <= bound
        assert trim(gaussians, cameras, pipeline(), True, 0.99 * bound, 1)[0].max_sh_degree > degree
    assert all(torch.equal(values, before[name]) for name, values in parameters(gaussians).items())


def test_a_model_that_no_view_sees_is_kept(cameras):
    gaussians = model(5)
    with torch.no_grad():
        gaussians._opacity.fill_(-50.0)
    assert trim(gaussians, cameras, pipeline(), False, -1.0, iterations=10**6)[0] is gaussians


def test_faint_gaussians_go_without_a_look(runs, cameras, monkeypatch):
    """No pixel takes an alpha below 1/255, so opacities below it are in no image from anywhere."""
    gaussians = model(200, seed=4)
    with torch.no_grad():
        gaussians._opacity[:50] = FAINT - 1e-3
        gaussians._opacity[50:60] = -math.log(254) + 1e-3
        gaussians._scaling[:60] += 3
    monkeypatch.setattr(trimming, "decisive_for", None)  # is not called
    trimmed, search = trim(gaussians, cameras, pipeline(), False, -1.0, iterations=10)
    assert search.end == TOO_LONG and search.unseen == search.faint == 50
    for camera in _walked(_load(runs.whole)[0])[::20]:
        assert torch.equal(_image(camera, gaussians), _image(camera, trimmed))
        assert not decisive_for(camera, gaussians, pipeline())[:50].any()
        assert decisive_for(camera, gaussians, pipeline())[50:60].any()


def test_few_unseen_ones_are_kept_without_looking_further(cameras):
    gaussians = model(200, seed=4)
    with torch.no_grad():
        # Just below what a pixel takes, and just above what counts as faint.
        gaussians._opacity[:1] = FAINT + 5e-5
    assert not decisive_for_any(cameras, gaussians, pipeline())[0]
    kept, search = trim(gaussians, cameras, pipeline(), False, -1.0, iterations=10**6)
    assert search.end == FEW and kept is gaussians and search.views == len(cameras)
    with torch.no_grad():
        gaussians._opacity[:2] = FAINT + 5e-5
    gone, search = trim(gaussians, cameras, pipeline(), False, -1.0, iterations=10**6)
    assert search.end == DONE and search.unseen == 2 and search.faint == 0


def test_many_cameras_have_fewer_neighbours(cameras):
    pairs, views = walk_pairs(cameras, 10**6)
    assert pairs == neighbours(cameras, NEAREST) and views == len(cameras) + 4 * len(pairs)
    fewer, views = walk_pairs(cameras, views - 1)
    assert fewer == neighbours(cameras, NEAREST - 1) and views == len(cameras) + 4 * len(fewer)
    tree, views = walk_pairs(cameras, 5 * len(cameras) - 4)
    assert len(tree) == len(cameras) - 1 and views == 5 * len(cameras) - 4
    assert walk_pairs(cameras, views - 1) == ([], views)


def _standing(centers: np.ndarray, turns: Rotation, **changes: object) -> list[Camera]:
    """Cameras with no photos, as far as `neighbours` and `views_between` look at them."""
    made = {"image_width": 40, "image_height": 30, "fx": 50.0, "fy": 60.0, "cx": 22.0, "cy": 14.0, "device": "cpu"}
    rows = zip(np.asarray(centers, float), turns.as_matrix(), strict=True)
    return [SimpleNamespace(R=turn, T=-turn.T @ center, **(made | changes)) for center, turn in rows]


def test_neighbours_in_a_sequence_in_a_ring_and_in_groups():
    straight = Rotation.from_rotvec(np.zeros((10, 3)))
    line = np.arange(10)[:, None] * [1.0, 0, 0]
    assert {(i, i + 1) for i in range(9)} <= set(neighbours(_standing(line, straight), 2))
    angles = np.arange(10) * 2 * np.pi / 10
    ring = np.stack([np.cos(angles), 0 * angles, np.sin(angles)], 1)
    turned = Rotation.from_rotvec(-angles[:, None] * [0, 1.0, 0])
    around = {(i, i + 1) for i in range(9)} | {(0, 9)}
    assert set(neighbours(_standing(ring, turned), 2)) == around
    groups = np.concatenate([line[:5], line[:5] + [1000.0, 0, 0]])
    joined = neighbours(_standing(groups, straight), 1)
    assert (4, 5) in joined  # the groups' nearest members
    back = Rotation.from_rotvec([[0, 0, 0], [0, np.pi, 0], [0, 0.1, 0]])
    close = _standing(np.array([[0, 0, 0], [0.1, 0, 0], [0.15, 0, 0.0]]), back)
    assert (0, 2) in neighbours(close, 1)  # a camera that looks the other way is not near
    assert neighbours(_standing(line[:1], straight[:1])) == []
    assert len(neighbours(_standing(line[:4] * 0, straight[:4]), 0)) == 3  # all in one place


def test_a_view_between_is_interpolated():
    turns = Rotation.from_rotvec([[0.1, 0.2, -0.3], [1.0, -2.0, 0.5]])
    first, second = _standing(np.array([[1.0, 2, 3], [4, 0, -1]]), turns)
    second.fx, second.fy, second.cx, second.cy, second.image_width = 80.0, 70.0, 33.0, 15.0, 60
    views = views_between(first, second)
    assert len(views) == len(FRACTIONS) >= 4
    for fraction, view in zip(FRACTIONS, views, strict=True):
        center = (1 - fraction) * np.array([1.0, 2, 3]) + fraction * np.array([4.0, 0, -1])
        np.testing.assert_allclose(view.camera_center, center, atol=1e-5)
        turn = Slerp([0, 1], turns)(fraction).as_matrix()
        np.testing.assert_allclose(view.world_view_transform[:3, :3], turn, atol=1e-6)
        assert (view.image_width, view.image_height) == (WIDER * 60, WIDER * 30)
        assert view.image_width / (2 * math.tan(view.FoVx / 2)) == pytest.approx(50 + 30 * fraction)
        assert view.image_height / (2 * math.tan(view.FoVy / 2)) == pytest.approx(60 + 10 * fraction)
        ahead = torch.tensor([*(center + turn @ [0, 0, 5.0]), 1.0], dtype=torch.float32)
        clip = ahead @ view.full_proj_transform
        # The principal points lie 2 px right of the first image's centre and 3 of the second's.
        assert (clip[0] / clip[3]).item() * view.image_width / 2 == pytest.approx(2 + fraction, abs=1e-3)
        assert (clip[1] / clip[3]).item() * view.image_height / 2 == pytest.approx(-1 + fraction, abs=1e-3)
