"""Camera paths: keyframe files, paths through and around training cameras, and views from free poses."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from diff_gaussian_rasterization.lens import lens_of
from gaussians import model, pipeline
from scipy.spatial.transform import Rotation, Slerp

from gaussian_renderer import render
from gaussian_renderer.camera_paths.generated import GENERATED, Ellipse, Interpolated, Spiral, visiting_order
from gaussian_renderer.camera_paths.keyframes import (
    CameraPath,
    Keyframe,
    KeyframePath,
    TimedPath,
    frame_count,
    frame_moment,
    read_camera_path,
)
from gaussian_renderer.camera_paths.poses import Poses, focus_point, look_along, ray_through
from gaussian_renderer.free_view import free_view, rotation_matrix
from scene.cameras import Camera
from scene.readers.info import CameraInfo
from scene.readers.tracks import projected
from utils.system_utils import UserError

UP = np.array([0.0, -1.0, 0.0])  # of COLMAP's world, as usual captures have it


def about_y(*degrees: float) -> Rotation:
    return Rotation.from_rotvec(np.radians(degrees)[:, None] * [0, 1, 0])


def looking_at(positions: np.ndarray, target: np.ndarray, up: np.ndarray = UP, fov: float = 40.0) -> Poses:
    """Cameras at (N,3) that look at a point (3,), or each at its own (N,3)."""
    targets = np.broadcast_to(target, positions.shape)
    turns = [look_along(to - at, up) for at, to in zip(positions, targets, strict=True)]
    return Poses(positions, np.array(turns), np.full(len(positions), fov))


def on_ring(count: int, radius: float = 3.0, height: float = 1.0, target: np.ndarray | None = None) -> Poses:
    angles = np.arange(count) * 2 * math.pi / count
    positions = np.column_stack([radius * np.cos(angles), np.full(count, -height), radius * np.sin(angles)])
    return looking_at(positions, np.zeros(3) if target is None else target)


def on_wall(count: int = 5, depth: float = 4.0) -> Poses:
    """Cameras side by side and above each other, which look at a point `depth` ahead."""
    x, y = np.meshgrid(np.linspace(-1, 1, count), np.linspace(-0.5, 0.5, 3))
    positions = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    return looking_at(positions, np.array([0, 0, depth]))


def sampled(path: TimedPath, count: int = 400) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, turns and opening angles; each pose is checked."""
    keys = [path.at(moment) for moment in np.linspace(0, path.seconds, count)]
    rows = np.array([[*key.position, *key.wxyz, key.fov] for key in keys])
    assert np.isfinite(rows).all()
    np.testing.assert_allclose(np.linalg.norm(rows[:, 3:7], axis=1), 1, rtol=0, atol=1e-9)
    return rows[:, :3], np.array([rotation_matrix(row) for row in rows[:, 3:7]]), rows[:, 7]


def steps(positions: np.ndarray, turns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances and angles (radians) between neighbours."""
    angles = Rotation.from_matrix(turns[1:] @ turns[:-1].transpose(0, 2, 1)).magnitude()
    return np.linalg.norm(np.diff(positions, axis=0), axis=1), angles


def near(one: object, other: object, error: float = 1e-9) -> None:
    np.testing.assert_allclose(one, other, rtol=0, atol=error)


def test_a_free_view_draws_what_a_camera_with_a_centred_lens_draws():
    gaussians, turn, fov_y = model(60, seed=3), Rotation.from_euler("xyz", [0.1, 1.3, 0.3]), 0.7
    fov_x, position = 2 * math.atan(math.tan(fov_y / 2) * 60 / 40), -2.5 * turn.as_matrix()[:, 2]
    given = {"R": turn.as_matrix(), "T": -turn.inv().apply(position), "FoVx": fov_x, "FoVy": fov_y, "uid": 0}
    camera = Camera(colmap_id=1, image=torch.zeros(3, 40, 60), gt_alpha_mask=None, image_name="a", **given)
    views = camera, free_view(60, 40, fov_y, position, turn.as_quat(scalar_first=True), camera.device)
    with torch.no_grad():
        one, other = (render(view, gaussians, pipeline(), torch.zeros(3))["render"] for view in views)
    assert one.max() > 0.1
    torch.testing.assert_close(one, other, rtol=0, atol=2e-5)


# Keyframe files


def keyframes(easing: str = "linear", sign: float = 1.0) -> CameraPath:
    """Three keyframes. sign: of the quaternions after the first."""
    turned = about_y(0, 90, 100).as_quat(scalar_first=True) * [[1], [sign], [sign]]
    places, moments, angles = [(0.0, 0, 0), (2, 0, 0), (2, 4, 0)], (0.0, 1.0, 3.0), (30.0, 50.0, 40.0)
    rows = zip(moments, places, turned.tolist(), angles, strict=True)
    return CameraPath(tuple(Keyframe(at, place, tuple(wxyz), fov) for at, place, wxyz, fov in rows), easing)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_keyframes_are_joined_at_constant_speed_on_lines_and_turn_the_short_way(sign):
    path = KeyframePath(keyframes(sign=sign))
    slerp = Slerp([0, 1, 3], about_y(0, 90, 100))
    for moment in np.linspace(0, 3, 31):
        key = path.at(moment)
        near(key.position, (2 * moment, 0, 0) if moment <= 1 else (2, 2 * (moment - 1), 0), 1e-12)
        near(rotation_matrix(key.wxyz), slerp(moment).as_matrix())
        assert key.fov == pytest.approx(np.interp(moment, [0, 1, 3], [30, 50, 40]))


def test_smooth_keyframes_stand_still_at_each_of_them():
    path = KeyframePath(keyframes("smooth"))
    for moment, place in ((0, (0, 0, 0)), (1, (2, 0, 0)), (3, (2, 4, 0))):
        near(path.at(moment).position, place, 1e-12)
        for beside in (moment - 1e-3, moment + 1e-3):
            near(path.at(min(max(beside, 0), 3)).position, place, 2e-5)
    assert path.at(0.25).position[0] == pytest.approx(2 * 10 / 64)  # u = 1/4: 3/16 - 2/64
    assert path.at(0.5).fov == pytest.approx(40)


def test_a_written_path_is_read_back(tmp_path):
    keyframes("smooth").write(tmp_path / "a.json")
    read = read_camera_path(tmp_path / "a.json")
    assert read.easing == "smooth" and read.seconds == 3
    for one, other in zip(read.keyframes, keyframes().keyframes, strict=True):
        near([one.seconds, one.fov, *one.wxyz, *one.position], [other.seconds, other.fov, *other.wxyz, *other.position])


KEY = {"seconds": 0, "position": [0, 0, 0], "wxyz": [1, 0, 0, 0], "fov": 50}


def _two(**changes: object) -> dict:
    return {"keyframes": [KEY, {**KEY, "seconds": 1, **changes}]}


BROKEN = {
    "": "is not JSON",
    "\xff": "is not JSON",
    "[" * 100_000: r"is not JSON \(nested too deep\)",
    "[1]": "needs a list called keyframes",
    json.dumps({"keyframes": [KEY]}): "has 1 keyframes; a camera path needs at least 2",
    json.dumps({"keyframes": [KEY, 5]}): "keyframe 2 must be an object",
    json.dumps(_two(seconds=0)): "keyframe 2 is at 0.0 s, not after keyframe 1",
    json.dumps({"keyframes": [{**KEY, "seconds": 1}, {**KEY, "seconds": 2}]}): "keyframe 1 must be at 0 seconds",
    json.dumps(_two() | {"easing": "fast"}): "easing must be linear or smooth, got 'fast'",
    json.dumps(_two(fov=0)): "keyframe 2: fov must be 0.001 to 179.9 degrees, got 0",
    json.dumps(_two(fov=[50])): r"fov must be a number, got \[50\]",
    json.dumps(_two(fov=True)): "fov must be a number, got True",
    json.dumps(_two(fov=math.nan)): "fov must be a number, got nan",
    json.dumps(_two(seconds=10**400)): "seconds must be a number, got 1000",
    json.dumps(_two(position=[0, 0])): "position must be 3 numbers",
    json.dumps(_two(position=[0, 0, 2e12])): r"position must be at most 1e\+12 from the origin",
    json.dumps(_two(position=None)): "position must be 3 numbers, got None",
    json.dumps(_two(wxyz=[0, 0, 0, 0])): "wxyz must be a unit quaternion",
}


@pytest.mark.parametrize("text", BROKEN, ids=lambda text: text[:70])
def test_a_broken_file_is_refused_in_one_sentence(tmp_path, text):
    file = tmp_path / "path.json"
    file.write_bytes(text.encode("latin-1"))
    with pytest.raises(UserError, match=BROKEN[text]) as refused:
        read_camera_path(file)
    assert "path.json" in str(refused.value) and "\n" not in str(refused.value) and len(str(refused.value)) < 300


def test_a_file_that_cannot_be_read_is_refused_and_the_example_of_the_docs_is_read(tmp_path):
    for path in (tmp_path, tmp_path / "none.json", tmp_path / "\0"):
        with pytest.raises(UserError, match="^(cannot read the camera path|the camera path .* is not JSON) "):
            read_camera_path(path)
    page = Path(__file__).resolve().parents[1] / "docs" / "guide" / "videos.md"
    (tmp_path / "a.json").write_text(page.read_text(encoding="utf-8").split("```json\n")[1].split("```")[0])
    assert len(read_camera_path(tmp_path / "a.json").keyframes) >= 2


def test_frames_of_open_and_of_closed_paths():
    open_path, closed, odd = KeyframePath(keyframes()), Ellipse(on_ring(12), 2.0), Interpolated(on_ring(12), 1.02)
    assert [frame_count(path, 30) for path in (open_path, closed, odd)] == [91, 60, 32]
    assert [frame_moment(open_path, 30, n) for n in (0, 1, 90)] == [0, 1 / 30, 3]
    assert frame_count(Ellipse(on_ring(12), 0.1), 1) == 1 and frame_moment(odd, 30, 31) == 1.02  # not beyond the end


# Paths through the cameras


def test_interpolate_passes_each_camera_smoothly_at_constant_speed():
    rng = np.random.default_rng(0)
    angles = np.sort(rng.uniform(0, 5, 12))
    positions = np.column_stack([3 * np.cos(angles), rng.normal(0, 0.2, 12), 3 * np.sin(angles)])
    poses = Poses(positions, looking_at(positions, np.zeros(3)).turns, rng.uniform(30, 60, 12))
    path = Interpolated(poses, 8.0)
    places, turns, fov = sampled(path, 4001)
    nearest = [np.linalg.norm(places - position, axis=1).argmin() for position in positions]
    near(places[nearest], positions, 0.003)
    near(turns[nearest], poses.turns, 0.003)
    near(fov[nearest], poses.fov, 0.2)
    moved, turned = steps(places, turns)
    speed = moved + poses.spread * turned
    np.testing.assert_allclose(speed, speed.mean(), rtol=0.03)
    # First derivatives are continuous: from sample to sample they change the less, the denser the samples are.
    changes = []
    for count in (4001, 16001):
        dense, axes, _ = sampled(path, count)
        rates = np.diff(np.column_stack([dense, axes.reshape(-1, 9)]), axis=0) * count
        changes.append(np.linalg.norm(np.diff(rates, axis=0), axis=1).max())
    assert changes[1] < 0.3 * changes[0]
    near(places[[0, -1]], positions[[0, -1]])
    assert fov.min() >= poses.fov.min() and fov.max() <= poses.fov.max()


def test_a_walk_is_kept_and_photos_in_no_order_are_not_criss_crossed():
    walk = on_ring(30)
    assert visiting_order(walk).tolist() == list(range(30))
    mixed = np.append(0, 1 + np.random.default_rng(1).permutation(29))
    visited = mixed[visiting_order(walk[mixed])]
    around = set((np.diff(visited) % 30).tolist())
    assert sorted(visited) == list(range(30)) and around in ({1}, {29})
    # One far jump between two walks is no reason to leave the order.
    two = walk[np.tile(np.arange(30), 2)]
    two.positions[30:, 0] += 50
    assert visiting_order(two).tolist() == list(range(60))


def test_interpolate_turns_on_the_spot_the_short_way_merges_equal_poses_and_stays_on_a_line():
    """Quaternions of a full circle change their sign on the way."""
    turns = about_y(0, *range(0, 360, 40), 320, 320).as_matrix()
    path = Interpolated(Poses(np.ones((12, 3)), turns, np.full(12, 50.0)), 8.0)
    assert len(path.keys) == 9
    places, turned, _ = sampled(path, 321)
    near(places, 1, 1e-12)
    near(turned[::40], turns[1:10], 1e-3)
    assert steps(places, turned)[1] == pytest.approx(math.radians(1), rel=0.02)
    line = Interpolated(looking_at(np.array([[0, 0, 0], [1, 0, 0], [5.0, 0, 0]]), np.array([2, 0, 9.0])), 3.0)
    places, _, _ = sampled(line)
    assert np.abs(places[:, 1:]).max() < 1e-12 and (np.diff(places[:, 0]) > 0).all()


# The focus, and paths around it


def test_the_focus_is_the_point_nearest_to_all_axes():
    target, rng = np.array([0.3, -0.2, 0.5]), np.random.default_rng(0)
    near(focus_point(on_ring(9, target=target)), target)
    poses = looking_at(rng.normal(0, 3, (20, 3)), target + rng.normal(0, 0.1, (20, 3)))
    found = focus_point(poses)

    def error(point: np.ndarray) -> float:
        return float((np.cross(point - poses.positions, poses.forward) ** 2).sum())

    assert error(found) < min(error(found + 1e-3 * step) for step in (*np.eye(3), *-np.eye(3)))
    assert focus_point(looking_at(rng.normal(0, 1, (9, 3)), np.array([0, 0, 1e6]))) is None  # parallel
    assert focus_point(looking_at(poses.positions, 2 * poses.positions)) is None  # outwards


def test_the_ellipse_goes_around_at_constant_speed_and_looks_at_the_focus():
    path = Ellipse(looking_at(on_ring(40, height=1.5).positions * [2, 1, 1], np.zeros(3)), 6.0)
    places, turns, fov = sampled(path, 601)
    near(places[:, 1], -1.5)
    axes = np.abs(places).max(axis=0)[[0, 2]]
    assert axes == pytest.approx([6, 3], rel=0.03)
    near((places[:, [0, 2]] / axes) ** 2 @ [1, 1], 1, 1e-3)
    near(turns[:, :, 2], -places / np.linalg.norm(places, axis=1, keepdims=True))
    assert (-turns[:, :, 1] @ UP).min() > 0.8  # never upside down
    near(turns[:, :, 0] @ UP, 0)  # the horizon is level
    moved, turned = steps(places, turns)
    np.testing.assert_allclose(moved, moved.mean(), rtol=0.01)
    assert turned.max() < 0.05 and np.linalg.norm(places[0] - places[-1]) < 1e-9 and (fov == 40).all()
    near(np.linalg.det(turns), 1)


@pytest.mark.parametrize(
    "poses", [on_wall(), on_wall()[np.array([5, 9])], on_wall()[np.arange(5)], on_ring(40)[np.arange(-7, 7)]]
)
def test_the_ellipse_stays_within_the_arc_that_cameras_cover(poses):
    places, turns, _ = sampled(Ellipse(poses, 5.0))
    reach = max(np.linalg.norm(poses.positions - at, axis=1).min() for at in places)
    assert reach < np.linalg.norm(np.diff(poses.positions, axis=0), axis=1).max() + 0.1
    moved, turned = steps(places, turns)
    assert moved.max() < 0.2 and turned.max() < 0.1 and np.ptp(places, axis=0).max() > 0.5
    assert (-turns[:, :, 1] @ UP).min() > 0.5


def test_the_spiral_turns_twice_before_the_scene():
    path = Spiral(on_wall(), 4.0)
    places, turns, _ = sampled(path, 401)
    near(path.target, [0, 0, 4])
    np.testing.assert_allclose(np.abs(places).max(axis=0), path.radii, rtol=1e-3, atol=1e-9)
    near(path.radii, [1, 0.5, 0])
    near(places[0], places[-1])
    angle = np.unwrap(np.arctan2(places[:, 1] / 0.5, places[:, 0]))
    assert abs(angle[-1] - angle[0]) == pytest.approx(4 * math.pi)
    near(turns[:, :, 2], (path.target - places) / np.linalg.norm(path.target - places, axis=1, keepdims=True))
    assert (-turns[:, :, 1] @ UP).min() > 0.9


ONE = looking_at(np.array([[0.0, -1, -3]]), np.zeros(3))
SPOT = Poses(np.ones((9, 3)), on_ring(9).turns, np.full(9, 40.0))
PARALLEL = Poses(on_wall().positions, np.broadcast_to(np.eye(3), (15, 3, 3)), np.full(15, 40.0))


@pytest.mark.parametrize(
    ("name", "poses", "sentence"),
    [
        ("interpolate", ONE, "two training cameras with different poses"),
        ("interpolate", ONE[np.zeros(4, int)], "two training cameras with different poses"),
        ("ellipse", ONE, "in at least two places"),
        ("ellipse", SPOT, "in at least two places"),
        ("ellipse", PARALLEL, "look at one point, and these look past each other or outwards"),
        ("ellipse", Poses(on_ring(9).positions, -on_ring(9).turns * [1, -1, 1], np.ones(9)), "or outwards"),
        ("spiral", ONE, "in at least two places"),
        ("spiral", SPOT, "in at least two places"),
        ("spiral", on_ring(9), "that face one way, and these face many"),
    ],
)
def test_cameras_that_a_path_cannot_be_made_of(name, poses, sentence):
    with pytest.raises(UserError, match=rf"^--path {name} needs .*{sentence}") as refused:
        GENERATED[name](poses, 2.0)
    assert "--path" in str(refused.value).partition(";")[2] and "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "lens",
    [
        None,
        lens_of("OPENCV", (330.0, 340.0, 205.0, 140.0, -0.2, 0.05, 0.01, -0.01)),
        lens_of("OPENCV_FISHEYE", (150.0, 150.0, 200.0, 150.0, 0.05, -0.01, 0.0, 0.0)),
    ],
)
def test_points_on_the_ray_through_a_place_of_a_photo_are_seen_there(lens):
    turn, place = Rotation.from_rotvec([0.4, -0.7, 0.2]).as_matrix(), np.array([1.0, 2.0, -3.0])
    lenses = {"fx": 330.0, "fy": 340.0, "cx": 205.0, "cy": 140.0, "native": lens}
    info = CameraInfo(0, turn, -turn.T @ place, width=400, height=300, file_size=(800, 600), **lenses)
    ray = ray_through(Camera(info, (200, 150), 0), 640.0, 120.0)
    x, y, is_shown = projected(info, (place + 3 * ray / np.linalg.norm(ray))[None])
    assert is_shown.all() and [*x, *y] == pytest.approx([320, 60], abs=0.03)
