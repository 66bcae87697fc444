"""Lenses that are refined with the poses: what pixels and tracks say of them, starts, trainings, files, checkpoints."""

import json
import math
from argparse import Namespace
from pathlib import Path

import numpy as np
import pytest
import torch
from diff_gaussian_rasterization.lens import MODELS, Lens
from lenses import make_lens
from rasterizer_tools import few, render
from synthetic import BROWN, CENTER, FOCAL, make_colmap_scene, options_of
from test_camera_gradients import _gradient_of_numbers
from trainings import differences, trained

from benchmarks.scenes.poses import disturbed
from benchmarks.workloads.splat_scenes import settings
from scene.gaussian_model import GaussianModel
from scene.images.lens import rays_of
from scene.lens_correction import ENDS, allowed, corrected, lens_gradient, ray_slopes
from scene.pose_file import NAME, with_poses
from scene.readers.colmap import read_colmap
from scene.reprojection import BOUND
from scene.scene import Scene
from splatting.training import checks
from splatting.training.bounded_adam import BoundedAdam
from splatting.training.lens_refinement import TOGETHER
from splatting.training.pose_refinement import PoseRefinement
from utils.system_utils import UserError

FISHEYE = (90.0, 90.0, *CENTER, 0.05, -0.01, 0.003, -0.001)


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE"])
def test_rays_of_fixed_pixels_follow_a_lens_as_pycolmaps_do(model):
    lens = make_lens(model, 90.0, 120, 90)
    chart, _, places = MODELS[model]
    pixels = np.array([[60.0, 45.0], [10.0, 20.0], [100.0, 80.0], [30.0, 70.0]])

    def rays(change: np.ndarray) -> np.ndarray:
        values = corrected(np.array(native.values), change)
        fields = Lens(chart, (1, 1), (0, 0)).with_values(values.tolist())
        further = (getattr(fields, name)[at] for name, at in places)
        return numbers(rays_of(lens._replace(params=(*values[:2], *(values[2:4] + 0.5), *further)), pixels))

    def numbers(found: np.ndarray) -> np.ndarray:
        away = np.hypot(*found.T)[:, None]
        return found * np.arctan(away) / away if chart == "equidistant" else found

    native = Lens(chart, lens.params[:2], tuple(at - 0.5 for at in lens.params[2:4]))
    for (name, at), value in zip(places, lens.params[4:], strict=True):
        terms = list(getattr(native, name))
        terms[at] = value
        native = native._replace(**{name: tuple(terms)})
    slopes = ray_slopes(native, numbers(rays_of(lens, pixels)))
    used = np.flatnonzero(np.diag(allowed(native)))
    assert len(used) == 4 + len(places) and np.trace(allowed(native)) == pytest.approx(len(used) - 1)  # fx is fy
    for number in used:
        step = 1e-5 * np.eye(15)[number]
        wanted = (rays(step) - rays(-step)) / 2e-5
        np.testing.assert_allclose(slopes[:, number].T, wanted, atol=1e-6 * max(1, np.abs(wanted).max()))


@pytest.mark.parametrize("native", [True, False])
def test_the_gradient_of_a_change(native):
    """Against central differences of an image in float64. No Gaussian is where the Jacobian is clamped."""
    parameters, size = few()
    further = (-0.05, 0.02, -0.01, 0.002, 0.01, 0.01, -0.002, 0.003, -0.004, 0.002, 0.001) if native else (0.0,) * 11
    start, width, height = np.array([16.0, 14.0, 8.0, 3.5, *further]), size["width"], size["height"]

    def camera(change: np.ndarray):
        values = corrected(start, change)
        if native:
            return settings(**size, lens=Lens("perspective", (1, 1), (0, 0)).with_values(values.tolist()))
        tangents = width / (2 * values[0]), height / (2 * values[1])
        at = (2 * values[2] + 1) / width - 1, (2 * values[3] + 1) / height - 1
        return settings(**size, fov=2 * math.atan(tangents[0]), tan_ratio=tangents[1] / tangents[0], principal=at)

    def total(change: np.ndarray) -> float:
        return float(render(parameters, camera(change)).color.sum())

    change = 0.01 * np.random.default_rng(0).normal(size=15) * (np.arange(15) < (15 if native else 4))
    numbers = _gradient_of_numbers(parameters, camera(change)).numpy()
    got = lens_gradient(numbers, corrected(start, change)[:2], change, native)
    steps = 1e-6 * np.eye(15)[: 15 if native else 4]
    wanted = [(total(change + step) - total(change - step)) / 2e-6 for step in steps]
    np.testing.assert_allclose(got[: len(wanted)], wanted, rtol=1e-5, atol=1e-5)
    assert not got[len(wanted) :].any()


def _with_params(scene: Path, change: tuple[float, ...]) -> Path:
    """Multiply the parameters of a scene's camera."""
    import pycolmap

    model = pycolmap.Reconstruction(str(scene / "sparse" / "0"))
    for camera in model.cameras.values():
        camera.params = np.array(camera.params) * change
    model.write_binary(str(scene / "sparse" / "0"))
    return scene


def _refinement(scene: Path, **more) -> tuple[Scene, PoseRefinement]:
    options = {"refine_poses": True, "refine_lens": True, "eval": True, "data_device": "cpu", "lenses": "native"}
    made = Scene(options_of(scene, scene / "out", **options | more), GaussianModel(1), start=False)
    return made, PoseRefinement(made, str(scene), 100, with_lens=True)


@pytest.mark.parametrize(
    ("model", "params", "factors", "astray"),
    [
        ("PINHOLE", (FOCAL, FOCAL, *CENTER), (1.01, 1.01, 1, 1), False),
        ("PINHOLE", (FOCAL, 100.0, *CENTER), (1.01, 0.98, 1.02, 0.97), True),
        ("OPENCV", BROWN, (1.01, 1.01, 1, 1.02, 0.9, 1.2, 0.8, 1.1), True),
        ("OPENCV_FISHEYE", FISHEYE, (1.01, 1.01, 1, 1, 1.1, 1, 1, 1), True),
    ],
)
def test_a_disturbed_lens_is_found_again_by_the_tracks(model, params, factors, astray, tmp_path):
    make_colmap_scene(tmp_path / "right", model=model, params=params)
    right, _ = _refinement(tmp_path / "right")
    scene = tmp_path / "right"
    if astray:
        scene = disturbed(scene, tmp_path / "off", 0.3, 0.5, 1)
    scene = _with_params(scene, factors)
    found, poses = _refinement(scene)
    for of in ("getTrainCameras", "getTestCameras"):
        for one, other in zip(getattr(found, of)(), getattr(right, of)(), strict=True):
            assert one.image_name == other.image_name
            np.testing.assert_allclose(one.shares[:4], other.shares[:4], rtol=5e-4)
            np.testing.assert_allclose(one.R, other.R, atol=2e-4)
            np.testing.assert_allclose(one.T, other.T, atol=2e-3)
            at = one.full_proj_transform.double() - other.full_proj_transform.double()
            assert at.abs().max() < 5e-3
    assert np.abs(poses.lens.change(0)).max() == 0  # it is where the training starts


def test_a_lens_whose_tracks_fit_stays(tmp_path):
    make_colmap_scene(tmp_path)
    _, poses = _refinement(tmp_path)
    assert poses.lens.shares(0).tolist()[:4] == [FOCAL / 96, FOCAL / 64, CENTER[0] / 96, CENTER[1] / 64]


def test_photos_of_a_camera_share_bounded_steps(tmp_path):
    make_colmap_scene(tmp_path)
    scene, poses = _refinement(tmp_path)
    poses._tracked.held = [held and (0 * held[0], 0 * held[1]) for held in poses._tracked.held]
    cameras = scene.getTrainCameras()
    gradient = np.zeros(34)
    gradient[[19, 22]] = 1.0, -2.0  # of the focal length across, and of the principal point down
    for _ in range(TOGETHER - 1):
        poses.step(0, gradient, 1, (96, 64))
    assert not poses.lens.change(0).any()
    poses.step(1, gradient, 1, (96, 64))
    change = poses.lens.change(5)
    assert change[0] == change[1] < 0 and change[2] == 0 and change[3] > 0 and not change[4:].any()
    poses.place()
    assert {tuple(camera.shares) for camera in (*cameras, *scene.getTestCameras())} == {tuple(cameras[0].shares)}
    assert cameras[0].fx < FOCAL and cameras[0].FoVx == pytest.approx(2 * math.atan(48 / cameras[0].fx))
    poses.lens._adam.values[0, :2] = 0.5
    for _ in range(TOGETHER):
        poses.step(0, gradient, 1, (96, 64))
    assert np.linalg.norm(poses.lens.change(0)[:2]) == pytest.approx(BOUND)
    assert poses.independent(0, [1] * TOGETHER) == 0 and poses.independent(0, [1] * (TOGETHER - 1)) == TOGETHER - 1
    assert poses.independent(0, [1] * (TOGETHER + 3)) == 3


def test_test_views_follow_the_lens_by_their_tracks(tmp_path):
    make_colmap_scene(tmp_path)
    scene, poses = _refinement(tmp_path)
    before = [camera.T.copy() for camera in scene.getTestCameras()]
    poses.lens._adam.values[0, :2] = 0.01
    poses._move(range(len(poses._cameras)))
    poses.place()
    for camera, old in zip(scene.getTestCameras(), before, strict=True):
        assert 1.005 < camera.T[2] / old[2] < 1.02  # a longer lens stands farther back


def test_bounded_adam_is_torchs():
    mine, rates = BoundedAdam(2, ENDS, 10.0), [0.1, 0.05, 0.02]
    value = torch.zeros(15, dtype=torch.float64, requires_grad=True)
    theirs = torch.optim.Adam([value], betas=(0.9, 0.99), eps=1e-12)
    for rate in rates:
        gradient = np.random.default_rng(int(100 * rate)).normal(size=15)
        mine.step(1, gradient, rate)
        theirs.param_groups[0]["lr"], value.grad = rate, torch.from_numpy(gradient)
        theirs.step()
    np.testing.assert_allclose(mine.values[1], value.detach().numpy(), rtol=1e-12)
    assert not mine.values[0].any()


@pytest.mark.parametrize(("model", "params"), [("PINHOLE", BROWN[:4]), ("OPENCV", BROWN)])  # bytes: OPTIONS, too
def test_a_resumed_training_has_the_bytes_of_a_whole_one(model, params, tmp_path):
    scene = tmp_path / "scene"
    make_colmap_scene(scene, model=model, params=params)
    _with_params(scene, (1.01, 1.01, *[1] * (len(params) - 2)))
    options = "--refine_poses", "--refine_lens", "--resolution_schedule", "pyramid", "--sparse_depth", 0.1
    whole = trained(scene, tmp_path / "whole", *options, "--checkpoint_iterations", 33, 60)
    start = "--start_checkpoint", tmp_path / "whole" / "chkpnt33.pth"
    resumed = trained(scene, tmp_path / "resumed", *options, *start)
    plain = trained(scene, tmp_path / "plain", *options, "--plain_step")
    assert not differences(whole, resumed) and not differences(whole, plain)
    tables = [(tmp_path / name / NAME).read_bytes() for name in ("whole", "resumed", "plain")]
    assert tables[0] == tables[1] == tables[2]
    entry = json.loads(tables[0])["train"][3]
    shares = [params[0] / 96, params[1] / 64, params[2] / 96, params[3] / 64]
    assert entry["lens"][:4] == pytest.approx(shares, rel=2e-3)
    loaded = Scene(
        options_of(scene, tmp_path / "whole", refine_poses=True, refine_lens=True, eval=True, lenses="native"),
        GaussianModel(1),
        load_iteration=60,
        start=False,
    )
    (camera,) = (one for one in loaded.getTrainCameras() if one.image_name == entry["img_name"])
    assert camera.shares == pytest.approx(entry["lens"], rel=1e-12) and camera.fx == pytest.approx(params[0], rel=2e-3)
    given = loaded.given_test_views()
    assert given[0].fx == pytest.approx(1.01 * params[0]) and loaded.getTestCameras()[0].fx != given[0].fx
    with pytest.raises(UserError, match="the checkpoint was trained with --refine_lens; give that option"):
        trained(scene, tmp_path / "other", "--refine_poses", *start)


def test_a_checkpoint_without_lenses_is_refused(tmp_path):
    make_colmap_scene(tmp_path)
    _, poses = _refinement(tmp_path)
    state = poses.captured()
    for wrong in (None, {"values": torch.zeros(2, 15)}):
        with pytest.raises(UserError, match="has no refined lenses of this run's cameras; leave --refine_lens out"):
            poses.restore(state | {"lenses": wrong})


def test_lenses_need_poses():
    with pytest.raises(UserError, match="give --refine_poses, too"):
        checks.check_poses(Namespace(refine_poses=False, refine_lens=True))
    checks.check_poses(Namespace(refine_poses=True, refine_lens=True))


@pytest.mark.parametrize("lens", [[1.0, 1.0, 0.5], [1.0, 1.0, 0.5, "x"], [-1.0, 1.0, 0.5, 0.5], 3, [math.inf] * 4])
def test_a_broken_lens_is_named(lens, tmp_path):
    make_colmap_scene(tmp_path)
    info = read_colmap(tmp_path, "images", True)
    lists = {"train": info.train_cameras, "test": info.test_cameras}
    table = {
        name: [{"img_name": v.image_name, "R": v.R.tolist(), "T": v.T.tolist(), "lens": lens} for v in views]
        for name, views in lists.items()
    }
    (tmp_path / NAME).write_text(json.dumps(table))
    with pytest.raises(UserError, match="has a lens that is not 4 numbers"):
        with_poses(info, tmp_path)
