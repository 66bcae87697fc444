"""Poses that are refined: by tracks, without drift of the whole, and through trainings, files and checkpoints."""

import json
import math
import sys
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from diff_gaussian_rasterization.reference.lens import pixels_of
from synthetic import BROWN, as_text, make_colmap_scene
from trainings import plain_training, shared_scene, train_on, trained

import metrics
import render
from applications.demo.make_scene import write_scene
from applications.demo.objects import demo_scene
from applications.demo.tracer import FISHEYE, ring_views
from applications.evaluation.plan import Run, SceneEntry
from applications.evaluation.results import read_run
from benchmarks.scenes.poses import disturb_poses
from scene.dataset_readers import SceneInfo
from scene.gaussian_model import GaussianModel
from scene.poses import moved
from scene.readers.colmap import read_colmap
from scene.readers.tracks import PhotoPoints, rays_to, read_tracks
from scene.reprojection import BOUND, moved_pose, nearest_pose, pose_loss, twist_gradient
from scene.scene import Scene
from splatting.features import refine_poses_steps as refinement
from splatting.features.refine_poses import NAME, with_poses
from splatting.features.refine_poses_steps import BoundedAdam, PoseRefinement
from utils.graphics_utils import camera_center, world_to_camera
from utils.system_utils import UserError

POSE = moved_pose(np.eye(4), np.array([0.3, -0.2, 0.5, 0.1, 0.2, 4.0]), 1.0)
TURN = np.array([0.01, -0.02, 0.015, 0.01, -0.015, 0.02])


def _errors(found: list, right: SceneInfo) -> list[float]:
    """Mean angle (degrees) and distance (percent of the extent) between poses and those of the views of their names."""
    views = {view.image_name: view for view in right.train_cameras + right.test_cameras}
    apart = []
    for one in found:
        other = views[one.image_name]
        chord = np.linalg.norm(one.R - other.R) / np.sqrt(8)
        moved = camera_center(one.R, one.T) - camera_center(other.R, other.T)
        apart.append([np.degrees(2 * np.arcsin(min(chord, 1))), 100 * np.linalg.norm(moved) / right.extent])
    return np.mean(apart, axis=0).tolist()


def _track(count: int = 60, noise: float = 0.0) -> PhotoPoints:
    rng = np.random.default_rng(1)
    points = rng.normal(size=(count, 3))
    view = points @ POSE[:3, :3].T + POSE[:3, 3]
    rays = view[:, :2] / view[:, 2:] + noise * rng.normal(size=(count, 2))
    return PhotoPoints(points, rays, rays, *np.ones((3, count)))


def _wide_track(count: int = 60, noise: float = 0.0, degrees: float = 120.0) -> PhotoPoints:
    """Return the track of a fisheye that sees points up to so many degrees from its axis.

    noise: radians.
    """
    rng = np.random.default_rng(1)
    angle, turn = np.radians(degrees) * np.sqrt(rng.uniform(size=count)), math.tau * rng.uniform(size=count)
    rays = angle[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    view = np.column_stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)])
    points = (rng.uniform(2, 5, (count, 1)) * view - POSE[:3, 3]) @ POSE[:3, :3]
    rays += noise * rng.normal(size=rays.shape)
    return PhotoPoints(points, rays, rays, *np.ones((3, count)), angular=True)


@pytest.mark.parametrize("degrees", [60.0, 92.0])
def test_fisheyes_find_a_pose_as_well_as_noise_allows(degrees):
    """The noise is 0.3 pixels of 200: points at the border do not count more, and those beyond 90 degrees do count."""
    track = _wide_track(300, 3e-3, degrees)
    assert nearest_pose(POSE, track, 100.0, 1.0, BOUND) is POSE  # which noise alone does not move
    found = nearest_pose(moved_pose(POSE, 0.3 * TURN, 1.0), track, 100.0, 1.0, BOUND)
    assert np.abs(found - POSE).max() < 2e-3


@pytest.mark.parametrize("track", [_track(noise=0.01), _wide_track(noise=0.01)], ids=["pinhole", "fisheye"])
def test_the_gradient_and_the_matrix_of_a_pull(track):
    step = 1e-5  # errors of about a pixel, on both sides of the outliers' limit
    pose = moved_pose(POSE, 0.1 * TURN, 2.0)
    at = pose_loss(pose, track, 90.0, 2.0)
    ends = [
        [pose_loss(moved_pose(pose, side * step * one, 2.0), track, 90.0, 2.0) for side in (1, -1)] for one in np.eye(6)
    ]
    np.testing.assert_allclose(at.gradient, [(a.loss - b.loss) / (2 * step) for a, b in ends], rtol=1e-6, atol=1e-6)
    inliers = pose_loss(pose, track, 0.9, 2.0)  # all errors are small
    exact = pose_loss(POSE, _wide_track() if track.angular else _track(), 0.9, 2.0)
    assert exact.loss < 1e-25 and np.abs(exact.gradient).max() < 1e-12
    assert np.linalg.eigvalsh(inliers.curvature).min() > 0


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_tracks_find_a_pose_again(noise):
    track = _track(200, noise)
    track.rays[::20] += 0.3  # a twentieth are wrong
    found = nearest_pose(moved_pose(POSE, TURN, 1.0), track, 500.0, 1.0, BOUND)
    assert np.abs(found - POSE).max() < 5e-3 + noise  # outliers pull with a bounded force
    assert np.abs(moved_pose(POSE, TURN, 1.0) - POSE).max() > 0.03


def test_a_camera_with_all_points_behind_it_stays():
    behind = np.diag([-1.0, 1, -1, 1]) @ POSE
    assert nearest_pose(behind, _track(), 500.0, 1.0, BOUND) is behind


def test_a_pose_may_stay():
    away = moved_pose(POSE, TURN, 1.0)
    assert nearest_pose(away, None, 500.0, 1.0, BOUND) is away
    assert nearest_pose(away, _track(), 500.0, 1.0, 0.01) is away  # farther than the bound
    noisy, near = _track(200, 1e-3), moved_pose(POSE, 1e-3 * TURN, 1.0)
    assert nearest_pose(near, noisy, 500.0, 1.0, BOUND) is near  # by a hundredth of the errors' size
    assert nearest_pose(moved_pose(POSE, 0.05 * TURN, 1.0), noisy, 500.0, 1.0, BOUND) is not near
    tracked = refinement.TrackedPoses([near], [noisy], [500.0], 1.0)
    assert not tracked.pulled(0, np.zeros(6)).any()  # it is held there
    assert tracked.pulled(0, TURN).any()


@pytest.mark.parametrize("params", [BROWN[:4], BROWN], ids=["pinhole", "distorted"])
def test_tracks_are_read(params, tmp_path):
    """pycolmap's points have exact projections."""
    make_colmap_scene(tmp_path, model="PINHOLE" if len(params) == 4 else "OPENCV", params=params)
    info = read_colmap(tmp_path, "images", True)
    views, offset = info.train_cameras + info.test_cameras, np.array([1.0, 2.0, 3.0])
    tracks = read_tracks(tmp_path, views, offset)
    assert min(len(track.points) for track in tracks) > 100
    for view, track in zip(views, tracks, strict=True):
        seen = (track.points + offset) @ view.R + view.T
        np.testing.assert_allclose(seen[:, :2] / seen[:, 2:], track.rays, atol=1e-6)


@pytest.mark.parametrize(("of", "value"), [("errors", "nan"), ("places", "inf"), ("places", "1e300")])
def test_what_no_track_can_have_is_left_out(of, value, tmp_path, capsys):
    make_colmap_scene(tmp_path)
    views = read_colmap(tmp_path, "images", False).train_cameras
    before = {view.image_name: len(track.points) for view, track in zip(views, _tracks(tmp_path, views), strict=True)}
    assert "not used" not in capsys.readouterr().err
    as_text(tmp_path)
    path = tmp_path / "sparse" / "0" / ("points3D.txt" if of == "errors" else "images.txt")
    lines = path.read_text().split("\n")
    first = next(number for number, line in enumerate(lines) if line and line[0] != "#") + (of == "places")
    words = lines[first].split()
    place = 7 if of == "errors" else next(i for i in range(0, len(words), 3) if words[i + 2] != "-1")
    words[place] = value
    lines[first] = " ".join(words)
    path.write_text("\n".join(lines))
    after = {view.image_name: len(track.points) for view, track in zip(views, _tracks(tmp_path, views), strict=True)}
    lost = sum(before.values()) - sum(after.values())
    assert lost == 1 if of == "places" else lost > 1
    assert f"{lost} 2D points of {tmp_path / 'sparse/0'} are not used: " in capsys.readouterr().err


def _tracks(scene: Path, views: list) -> list[PhotoPoints]:
    return read_tracks(scene, views, np.zeros(3))


def test_tracks_of_a_fisheye_reach_beyond_90_degrees(tmp_path, capsys):
    """They are the angles at which its lens shows their places, and pixels from where COLMAP's model shows them.

    Points beyond 90 degrees have no place in that, so that their errors in the file are no pixels.
    """
    pycolmap = pytest.importorskip("pycolmap")
    folder, size, rng = tmp_path / "scene", 64, np.random.default_rng(0)
    views = [replace(v, focal=size / np.radians(200)) for v in ring_views(6, size, size, rng, FISHEYE)]
    write_scene(folder, views, lambda _: demo_scene(), 300, rng, samples=1)
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    assert max(point.error for point in model.points3D.values()) > 1e100
    info = read_colmap(folder, "images", False, native=True)
    angles = []
    for view, track in zip(info.train_cameras, _tracks(folder, info.train_cameras), strict=True):
        shown = pixels_of(view.native, torch.from_numpy(track.rays)).numpy() + 0.5
        np.testing.assert_allclose(shown, track.places * size, atol=1e-5)
        (image,) = (image for image in model.images.values() if image.name == view.image_name)
        assert track.angular and len(track.points) == image.num_points3D and track.errors.max() < 3  # pixels
        local = track.points @ view.R + view.T
        theirs = model.cameras[image.camera_id].img_from_cam(local)
        ahead, away = local[:, 2] > 0, view.fx * np.linalg.norm(track.rays - rays_to(local, True), axis=1)
        np.testing.assert_allclose(np.linalg.norm(theirs - shown, axis=1)[ahead], away[ahead], atol=1e-6)
        assert away.max() < 5
        angles.append(np.degrees(np.arctan2(np.hypot(*local[:, :2].T), local[:, 2])).max())
    assert max(angles) > 98
    views = read_colmap(folder, "images", False, native=False).train_cameras  # which cuts 60 degrees from the axis
    capsys.readouterr()
    for view, track in zip(views, _tracks(folder, views), strict=True):
        at = np.abs(track.rays * (view.fx, view.fy) + (view.cx, view.cy) - np.array([view.width, view.height]) / 2)
        assert not track.angular and (at <= np.array([view.width, view.height]) / 2).all()
    assert "not used" not in capsys.readouterr().err


def _options(scene: Path, out: Path, **more) -> Namespace:
    values = {"source_path": str(scene), "model_path": str(out), "images": "images", "resolution": -1, "eval": True}
    values |= {"white_background": False, "train_test_exp": False, "data_device": "cpu", "refine_poses": True}
    return Namespace(**values | more)


def _refinement(folder: Path) -> tuple[Scene, PoseRefinement]:
    scene = Scene(_options(folder, folder / "out"), GaussianModel(1), start=False)
    return scene, PoseRefinement(scene, str(folder), 100)


def _poses(scene: Scene) -> np.ndarray:
    cameras = scene.getTrainCameras() + scene.getTestCameras()
    return np.array([world_to_camera(c.R, c.T) for c in sorted(cameras, key=lambda camera: camera.image_name)])


def test_all_views_begin_where_tracks_place_them(tmp_path):
    make_colmap_scene(tmp_path)
    wanted = _poses(Scene(_options(tmp_path, tmp_path / "out"), GaussianModel(1), start=False))
    folder = disturb_poses(tmp_path, tmp_path / "disturbed", 1.5, 1, 2)
    given = Scene(_options(folder, tmp_path / "out"), GaussianModel(1), start=False)
    assert np.abs(_poses(given) - wanted).max() > 0.02
    assert _errors(given.getTrainCameras(), read_colmap(tmp_path, "images", True)) == pytest.approx([1.5, 1], rel=1e-4)
    scene, _ = _refinement(folder)
    np.testing.assert_allclose(_poses(scene), wanted, atol=1e-6)
    for camera in scene.getTrainCameras():
        view = camera.world_view_transform.double().numpy().T
        np.testing.assert_allclose(view, world_to_camera(camera.R, camera.T), atol=1e-6)


def test_what_all_cameras_could_do_together_is_taken_out(tmp_path, monkeypatch):
    make_colmap_scene(tmp_path)
    scene, poses = _refinement(tmp_path)
    cameras, before = scene.getTrainCameras(), _poses(scene)
    monkeypatch.setattr(refinement, "_ANCHOR", 0.0)
    monkeypatch.setattr(refinement, "_PASSES", 1)
    rng = np.random.default_rng(3)
    own = rng.normal(size=poses.twists.shape) * 1e-3
    basis, inverse = poses._drift
    own -= (basis.T @ inverse @ basis @ own.reshape(-1)).reshape(own.shape)
    for _ in range(2):
        poses.twists[:] = own + (1e-3 * rng.normal(size=7) @ basis).reshape(own.shape)
        for camera in cameras:  # a pass over all views, without a gradient
            poses.step(camera.uid, np.zeros(34), 1)
        poses.place()
        np.testing.assert_allclose(poses.twists, own, atol=1e-12)
    # The basis is that of motions and of growth: a common one of the world is nothing but drift.
    common = np.array([0.002, -0.001, 0.003, 0.1, 0.2, -0.1])
    starts = poses._tracked.starts[: len(cameras)]
    turned = np.array([pose @ moved_pose(np.eye(4), 0.01 * common, 1.0) for pose in starts])
    change = np.array([turn @ np.linalg.inv(pose) for turn, pose in zip(turned, starts, strict=True)])
    twists = np.stack([change[:, 2, 1], change[:, 0, 2], change[:, 1, 0], *(change[:, k, 3] for k in range(3))], 1)
    twists[:, 3:] /= scene.cameras_extent
    left = twists.reshape(-1) - basis.T @ inverse @ basis @ twists.reshape(-1)
    assert np.abs(left).max() < 1e-4 * np.abs(twists).max()
    assert np.abs(_poses(scene) - before).max() > 1e-4


def _gradient(poses: PoseRefinement, uid: int, wanted: np.ndarray) -> np.ndarray:
    """Gradients of a camera's numbers that make a gradient (6,) of its twist in world units."""
    by_number = [twist_gradient(poses._pose(uid), one, 1.0) for one in np.eye(15)]
    return np.linalg.lstsq(np.transpose(by_number), wanted, rcond=None)[0]


def test_the_gradient_of_a_twist(tmp_path):
    """The gradient of the view's rows, translation and centre is compared with torch's through `moved`."""
    make_colmap_scene(tmp_path)
    scene, poses = _refinement(tmp_path)
    camera, twist = scene.getTrainCameras()[1], torch.zeros(6, dtype=torch.float64, requires_grad=True)
    for name in ("world_view_transform", "full_proj_transform", "camera_center"):
        setattr(camera, name, getattr(camera, name).double())
    turned = moved(camera, twist)
    weights = torch.randn(15, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    view = turned.world_view_transform
    (torch.cat([view[:3, :3].T.reshape(9), view[3, :3], turned.camera_center]) @ weights).backward()
    unit = torch.tensor([1.0, 1, 1, 2, 2, 2], dtype=torch.float64)
    got = twist_gradient(poses._pose(camera.uid), weights.numpy(), 2.0)
    np.testing.assert_allclose(got, unit * twist.grad, rtol=1e-5, atol=1e-5)


def test_bounded_adam_is_torchs(monkeypatch):
    monkeypatch.setattr(refinement, "BOUND", 10.0)
    mine, rates = BoundedAdam(2), [0.1, 0.05, 0.02]
    value = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    theirs = torch.optim.Adam([value], betas=(0.9, 0.99), eps=1e-12)
    for rate in rates:
        gradient = np.random.default_rng(int(100 * rate)).normal(size=6)
        mine.step(1, gradient, rate)
        theirs.param_groups[0]["lr"], value.grad = rate, torch.from_numpy(gradient)
        theirs.step()
    np.testing.assert_allclose(mine.values[1], value.detach().numpy(), rtol=1e-12)
    assert not mine.values[0].any()


def test_steps_are_bounded_and_follow_the_gradient(tmp_path, monkeypatch):
    make_colmap_scene(tmp_path)
    _, poses = _refinement(tmp_path)
    monkeypatch.setattr(refinement, "_ANCHOR", 0.0)
    monkeypatch.setattr(refinement, "_PASSES", 1)
    poses.step(2, _gradient(poses, 2, np.array([1.0, -1, 1, -1, 1, -1])), 0)
    assert np.array_equal(np.sign(poses.twists[2]), [-1, 1, -1, 1, -1, 1]) and not poses.twists[[0, 1, 3]].any()
    poses.twists[2, :3] = 3.0
    poses.step(2, _gradient(poses, 2, np.ones(6)), 0)
    assert np.linalg.norm(poses.twists[2, :3]) == pytest.approx(BOUND)
    before = poses.twists.copy()
    poses.step(2, np.full(34, np.nan), 0)
    poses._tracked.held[1] = None
    poses.step(1, np.ones(34), 0)
    assert np.array_equal(poses.twists, before)


def test_a_pose_depends_on_its_own_steps_and_on_whole_passes(tmp_path):
    make_colmap_scene(tmp_path)
    _, poses = _refinement(tmp_path)
    count = len(poses.twists)
    assert poses.count_independent(2, [0, 1]) == 2 and poses.count_independent(1, [0, 1, 1, 0, 2]) == 2
    whole = [0] * (refinement._PASSES * count)
    assert poses.count_independent(2, whole) == 0 and poses.count_independent(2, [*whole, 0, 1]) == 2
    assert poses.count_independent(2, whole[1:]) == len(whole) - 1
    poses.step(0, np.zeros(34), 0)
    assert poses.count_independent(2, whole[1:]) == 0 and poses.count_independent(0, [*whole, 0, 1]) == 1


@pytest.fixture(scope="module")
def scene(_colmap_master: Path) -> Path:
    return _colmap_master


def test_a_model_has_the_poses_that_a_training_found(once, tmp_path):
    scene, whole = shared_scene(once), plain_training(once, "poses")
    loaded = Scene(_options(scene, whole), GaussianModel(1), load_iteration=60, start=False)
    table = json.loads((whole / NAME).read_text())
    for name, cameras in (("train", loaded.getTrainCameras()), ("test", loaded.getTestCameras())):
        for camera in cameras:
            entry = table[name][camera.uid]
            assert entry["img_name"] == camera.image_name and entry["R"] == camera.R.tolist()
    plain = Scene(_options(scene, whole, refine_poses=False), GaussianModel(1), 60, start=False)
    assert np.abs(_poses(plain) - _poses(loaded)).max() > 1e-5
    with pytest.raises(UserError, match="chkpnt33.pth was trained with --refine_poses; give that option"):
        trained(scene, tmp_path / "other", "--start_checkpoint", whole / "chkpnt33.pth")
    unrefined = plain_training(once, "default")
    assert not (unrefined / NAME).exists()
    with pytest.raises(UserError, match="the checkpoint has no refined poses of this run's views"):
        trained(scene, tmp_path / "more", "--refine_poses", "--start_checkpoint", unrefined / "chkpnt33.pth")


def test_test_views_are_scored_with_given_poses_too(tmp_path, monkeypatch):
    make_colmap_scene(tmp_path / "right")
    scene, out = disturb_poses(tmp_path / "right", tmp_path / "scene", 1.5, 1, 2), tmp_path / "out"
    words = "--eval", "--iterations", 200, "--test_iterations", 200, "--densify_from_iter", 1000, "--disable_viewer"
    train_on(scene, out, *words, "--refine_poses")
    log = json.loads((out / "train_log.json").read_text())
    assert log[-1]["test_psnr"] > log[-1]["test_given_poses_psnr"] + 0.1
    assert len(log) >= 12 and all(record["pose_degrees"] == pytest.approx(1.5, abs=0.1) for record in log)
    assert all(record["pose_percent"] == pytest.approx(1, abs=0.1) for record in log)
    for command, *more in ((render, "--skip_train"), (metrics,)):
        monkeypatch.setattr(sys, "argv", ["x", "-m", str(out), *more])
        command.main()
    scores = json.loads((out / "results.json").read_text())
    assert scores.keys() == {"ours_200", "ours_200_given_poses"}
    assert scores["ours_200"]["PSNR"] > scores["ours_200_given_poses"]["PSNR"] + 0.1
    run = read_run(Run(SceneEntry("x", "scenes", scene), None, None, out, (), ()), tmp_path, None)
    assert run["iterations"]["200"]["PSNR_given_poses"] == scores["ours_200_given_poses"]["PSNR"]
    assert run["poses"] == [[record["seconds"], record["pose_degrees"], record["pose_percent"]] for record in log]
    (out / "model.json").write_text("{}")  # as of a training without refined poses
    monkeypatch.setattr(sys, "argv", ["x", "-m", str(out), "--skip_train"])
    render.main()
    assert [path.name for path in (out / "test").iterdir()] == ["ours_200"]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "cannot read .*poses.json"),
        ("[1]", "is no table of poses"),
        ("{", "is no table of poses"),
        ('{"train": []}', "is of other views than the scene's"),
        ('{"train": 1}', "has no list of poses"),
    ],
)
def test_a_broken_file_is_named(content, said, scene, tmp_path):
    if content is not None:
        (tmp_path / NAME).write_text(content)
    with pytest.raises(UserError, match=said):
        with_poses(read_colmap(scene, "images", True), tmp_path)
