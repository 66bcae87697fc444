"""Camera paths: keyframe files, paths through and around training cameras, and views from free poses."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from gaussians import model, pipeline
from scipy.spatial.transform import Rotation, Slerp

from gaussian_renderer import render
from gaussian_renderer.free_view import free_view, rotation_matrix
from scene.cameras import Camera
from splatting.camera_paths.generated import GENERATED, Ellipse, Spiral
from splatting.camera_paths.interpolated import KEYS_A_SECOND, Interpolated, visiting_order
from splatting.camera_paths.keyframes import CameraPath, Keyframe, read_camera_path
from splatting.camera_paths.moments import KeyframePath, TimedPath, frame_count, frame_moment
from splatting.camera_paths.poses import Poses, facing, focus_point, poses_of
from utils.system_utils import UserError

UP = np.array([0.0, -1.0, 0.0])  # of COLMAP's world, as usual captures have it


def about_y(*degrees: float) -> Rotation:
    return Rotation.from_rotvec(np.radians(degrees)[:, None] * [0, 1, 0])


def looking_at(positions: np.ndarray, target: np.ndarray, up: np.ndarray = UP, fov: float = 40.0) -> Poses:
    """Cameras at (N,3) that look at a point (3,), or each at its own (N,3)."""
    targets = np.broadcast_to(target, positions.shape)
    turns = [facing(to - at, up) for at, to in zip(positions, targets, strict=True)]
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


def test_poses_of_cameras_are_those_that_a_free_view_takes():
    poses = on_ring(7)
    views = [
        free_view(40, 30, math.radians(fov), place, wxyz, "cpu")
        for place, wxyz, fov in zip(poses.positions, poses.quaternions, poses.fov, strict=True)
    ]
    found = poses_of(views)
    for name in ("positions", "turns", "fov"):
        np.testing.assert_allclose(getattr(found, name), getattr(poses, name), rtol=0, atol=1e-5)


@pytest.mark.parametrize("angle", [0.0, 1.3, 2.6])
def test_a_free_view_draws_what_a_camera_with_a_centred_lens_draws(angle):
    gaussians, turn, fov_y = model(60, seed=3), Rotation.from_euler("xyz", [0.1, angle, 0.3]), 0.7
    fov_x = 2 * math.atan(math.tan(fov_y / 2) * 60 / 40)
    position = -2.5 * turn.as_matrix()[:, 2]
    given = {"R": turn.as_matrix(), "T": -turn.inv().apply(position), "FoVx": fov_x, "FoVy": fov_y, "uid": 0}
    camera = Camera(colmap_id=1, image=torch.zeros(3, 40, 60), gt_alpha_mask=None, image_name="a", **given)
    views = camera, free_view(60, 40, fov_y, position, np.roll(turn.as_quat(), 1), camera.device)
    with torch.no_grad():
        one, other = (render(view, gaussians, pipeline(), torch.zeros(3))["render"] for view in views)
    assert one.max() > 0.1
    torch.testing.assert_close(one, other, rtol=0, atol=2e-5)


# Keyframe files


def keyframes(easing: str = "linear") -> CameraPath:
    turned = about_y(0, 90, 100).as_quat()
    places, moments, angles = [(0.0, 0, 0), (2, 0, 0), (2, 4, 0)], (0.0, 1.0, 3.0), (30.0, 50.0, 40.0)
    rows = zip(moments, places, np.roll(turned, 1, axis=1), angles, strict=True)
    return CameraPath(tuple(Keyframe(at, place, tuple(wxyz), fov) for at, place, wxyz, fov in rows), easing)


def test_keyframes_are_joined_at_constant_speed_on_lines():
    path = KeyframePath(keyframes())
    slerp = Slerp([0, 1, 3], about_y(0, 90, 100))
    for moment in np.linspace(0, 3, 31):
        key = path.at(moment)
        place = (2 * moment, 0, 0) if moment <= 1 else (2, 2 * (moment - 1), 0)
        np.testing.assert_allclose(key.position, place, rtol=0, atol=1e-12)
        np.testing.assert_allclose(rotation_matrix(key.wxyz), slerp(moment).as_matrix(), rtol=0, atol=1e-12)
        assert key.fov == pytest.approx(np.interp(moment, [0, 1, 3], [30, 50, 40]))


def test_smooth_keyframes_stand_still_at_each_of_them():
    path = KeyframePath(keyframes("smooth"))
    for moment, place in ((0, (0, 0, 0)), (1, (2, 0, 0)), (3, (2, 4, 0))):
        np.testing.assert_allclose(path.at(moment).position, place, rtol=0, atol=1e-12)
        for near in (moment - 1e-3, moment + 1e-3):
            np.testing.assert_allclose(path.at(min(max(near, 0), 3)).position, place, rtol=0, atol=2e-5)
    # u = 1/4 of the first: 3/16 - 2/64
    assert path.at(0.25).position[0] == pytest.approx(2 * 10 / 64)
    assert path.at(0.5).fov == pytest.approx(40)
    np.testing.assert_allclose(path.at(2).position, (2, 2, 0))


def test_a_quaternion_of_the_other_sign_takes_the_short_way():
    plain = keyframes()
    first, *others = plain.keyframes
    flipped = CameraPath((first, *(Keyframe(k.seconds, k.position, tuple(-q for q in k.wxyz), k.fov) for k in others)))
    for one, other in zip(sampled(KeyframePath(plain)), sampled(KeyframePath(flipped)), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-9)
    assert steps(*sampled(KeyframePath(flipped))[:2])[1].max() < math.radians(1)


def test_a_written_path_is_read_back(tmp_path):
    keyframes("smooth").write(tmp_path / "a.json")
    read = read_camera_path(tmp_path / "a.json")
    assert read.easing == "smooth" and read.seconds == 3
    for one, other in zip(read.keyframes, keyframes().keyframes, strict=True):
        np.testing.assert_allclose([*one.wxyz, *one.position], [*other.wxyz, *other.position], rtol=0, atol=1e-15)
        assert (one.seconds, one.fov) == (other.seconds, other.fov)


KEY = {"seconds": 0, "position": [0, 0, 0], "wxyz": [1, 0, 0, 0], "fov": 50}


def _two(**changes: object) -> dict:
    return {"keyframes": [KEY, {**KEY, "seconds": 1, **changes}]}


BROKEN = {
    "": "is not JSON",
    "{": "is not JSON",
    "\xff": "is not JSON",
    "[" * 100_000: r"is not JSON \(nested too deep\)",
    "[1]": "needs a list called keyframes",
    '{"keyframes": {}}': "needs a list called keyframes",
    '{"keyframes": []}': "has 0 keyframes; a camera path needs at least 2",
    json.dumps({"keyframes": [KEY]}): "has 1 keyframes",
    json.dumps({"keyframes": [KEY, 5]}): "keyframe 2 must be an object",
    json.dumps(_two(seconds=0)): "keyframe 2 is at 0.0 s, not after keyframe 1",
    json.dumps({"keyframes": [{**KEY, "seconds": 1}, {**KEY, "seconds": 2}]}): "keyframe 1 must be at 0 seconds",
    json.dumps(_two() | {"easing": "fast"}): "easing must be linear or smooth, got 'fast'",
    json.dumps(_two() | {"easing": []}): "easing must be linear or smooth",
    json.dumps(_two(fov=0)): "keyframe 2: fov must be 0.001 to 179.9 degrees, got 0",
    json.dumps(_two(fov=180)): "fov must be",
    json.dumps(_two(fov=[50])): r"fov must be a number, got \[50\]",
    json.dumps(_two(fov=True)): "fov must be a number, got True",
    json.dumps(_two(fov=math.nan)): "fov must be a number, got nan",
    json.dumps(_two(seconds="1")): "seconds must be a number, got '1'",
    json.dumps(_two(seconds=10**400)): "seconds must be a number, got 1000",
    json.dumps(_two(position=[0, 0])): "position must be 3 numbers",
    json.dumps(_two(position=[0, 0, math.inf])): "position must be 3 numbers",
    json.dumps(_two(position=[0, 0, 2e12])): r"position must be at most 1e\+12 from the origin",
    json.dumps(_two(position=None)): "position must be 3 numbers, got None",
    json.dumps(_two(wxyz=[0, 0, 0, 0])): "wxyz must be a unit quaternion",
    json.dumps(_two(wxyz=[1, 0, 0])): "wxyz must be 4 numbers",
    json.dumps({"keyframes": [{"seconds": 0}]}): "keyframe 1: fov must be a number, got None",
}


@pytest.mark.parametrize("text", BROKEN, ids=lambda text: text[:70])
def test_a_broken_file_is_refused_in_one_sentence(tmp_path, text):
    file = tmp_path / "path.json"
    file.write_bytes(text.encode("latin-1"))
    with pytest.raises(UserError, match=BROKEN[text]) as refused:
        read_camera_path(file)
    assert "path.json" in str(refused.value) and "\n" not in str(refused.value) and len(str(refused.value)) < 300


def test_a_file_that_cannot_be_read_is_refused(tmp_path):
    for path in (tmp_path, tmp_path / "none.json", tmp_path / "\0"):
        with pytest.raises(UserError, match="^(cannot read the camera path|the camera path .* is not JSON) "):
            read_camera_path(path)


# Moments


def test_frames_of_open_and_of_closed_paths():
    open_path, closed = KeyframePath(keyframes()), Ellipse(on_ring(12), 2.0)
    assert frame_count(open_path, 30) == 91 and frame_count(closed, 30) == 60
    assert [frame_moment(open_path, 30, n) for n in (0, 1, 90)] == [0, 1 / 30, 3]
    assert frame_count(Ellipse(on_ring(12), 0.1), 1) == 1
    odd = Interpolated(on_ring(12), 1.02)
    assert frame_count(odd, 30) == 32 and frame_moment(odd, 30, 31) == 1.02  # not beyond the end


# Paths through the cameras


def test_interpolate_passes_each_camera_smoothly_at_constant_speed():
    rng = np.random.default_rng(0)
    angles = np.sort(rng.uniform(0, 5, 12))
    positions = np.column_stack([3 * np.cos(angles), rng.normal(0, 0.2, 12), 3 * np.sin(angles)])
    ring = looking_at(positions, np.zeros(3))
    poses = Poses(ring.positions, ring.turns, rng.uniform(30, 60, 12))
    path = Interpolated(poses, 8.0)
    places, turns, fov = sampled(path, 4001)
    for position, turn, angle in zip(poses.positions, poses.turns, poses.fov, strict=True):
        nearest = np.linalg.norm(places - position, axis=1).argmin()
        np.testing.assert_allclose(places[nearest], position, rtol=0, atol=0.003)
        np.testing.assert_allclose(turns[nearest], turn, rtol=0, atol=0.003)
        assert fov[nearest] == pytest.approx(angle, abs=0.2)
    moved, turned = steps(places, turns)
    speed = moved + poses.spread * turned
    np.testing.assert_allclose(speed, speed.mean(), rtol=0.03)
    # First derivatives are continuous: from sample to sample they change the less, the denser the samples are.
    changes = []
    for count in (4001, 16001):
        places, turns, _ = sampled(path, count)
        rates = np.diff(np.column_stack([places, turns.reshape(-1, 9)]), axis=0) * count
        changes.append(np.linalg.norm(np.diff(rates, axis=0), axis=1).max())
    assert changes[1] < 0.3 * changes[0]
    np.testing.assert_allclose(places[[0, -1]], poses.positions[[0, -1]], rtol=0, atol=1e-9)
    assert fov.min() >= poses.fov.min() and fov.max() <= poses.fov.max()


def test_a_walk_is_kept_and_photos_in_no_order_are_not_criss_crossed():
    walk = on_ring(30)
    assert visiting_order(walk).tolist() == list(range(30))
    mixed = np.random.default_rng(1).permutation(30)
    mixed = np.concatenate([[0], mixed[mixed != 0]])
    visited = mixed[visiting_order(walk[mixed])]
    around = np.diff(visited) % 30
    assert sorted(visited) == list(range(30)) and len(set(around.tolist())) == 1 and around[0] in (1, 29)
    # One far jump between two walks is no reason to leave the order.
    two = Poses(*(np.concatenate([getattr(walk, name)] * 2) for name in ("positions", "turns", "fov")))
    two.positions[30:, 0] += 50
    assert visiting_order(two).tolist() == list(range(60))


def test_of_many_cameras_three_a_second_are_passed():
    poses = on_ring(300)
    path = Interpolated(poses, 4.0)
    assert len(path.keys) == 4 * KEYS_A_SECOND
    gaps = np.linalg.norm(np.diff(path.keys.positions, axis=0), axis=1)
    assert gaps.max() < 1.2 * gaps.min()
    assert len(visiting_order(on_ring(2500))) == 1000


def test_interpolate_turns_on_the_spot_the_short_way_and_merges_equal_poses():
    """Quaternions of a full circle change their sign on the way."""
    turns = about_y(0, *range(0, 360, 40), 320, 320).as_matrix()
    path = Interpolated(Poses(np.ones((12, 3)), turns, np.full(12, 50.0)), 8.0)
    assert len(path.keys) == 9
    places, turned, _ = sampled(path, 321)
    np.testing.assert_allclose(places, 1, rtol=0, atol=1e-12)
    np.testing.assert_allclose(turned[::40], turns[1:10], rtol=0, atol=1e-3)
    assert steps(places, turned)[1] == pytest.approx(math.radians(1), rel=0.02)


def test_interpolate_of_cameras_on_a_line_stays_on_it():
    line = Interpolated(looking_at(np.array([[0, 0, 0], [1, 0, 0], [5.0, 0, 0]]), np.array([2, 0, 9.0])), 3.0)
    places, _, _ = sampled(line)
    assert np.abs(places[:, 1:]).max() < 1e-12 and (np.diff(places[:, 0]) > 0).all()


# The focus, and paths around it


def test_the_focus_is_the_point_nearest_to_all_axes():
    target = np.array([0.3, -0.2, 0.5])
    np.testing.assert_allclose(focus_point(on_ring(9, target=target)), target, rtol=0, atol=1e-9)
    rng = np.random.default_rng(0)
    poses = looking_at(rng.normal(0, 3, (20, 3)), target + rng.normal(0, 0.1, (20, 3)))
    found = focus_point(poses)

    def error(point: np.ndarray) -> float:
        across = np.cross(point - poses.positions, poses.forward)
        return float((across**2).sum())

    around = [error(found + 1e-3 * step) for step in (*np.eye(3), *-np.eye(3))]
    assert error(found) < min(around)
    parallel = looking_at(rng.normal(0, 1, (9, 3)), np.array([0, 0, 1e6]))
    assert focus_point(parallel) is None
    outwards = Poses(poses.positions, looking_at(poses.positions, 2 * poses.positions).turns, poses.fov)
    assert focus_point(outwards) is None


def test_the_ellipse_goes_around_at_constant_speed_and_looks_at_the_focus():
    ring, target = on_ring(40, height=1.5), np.array([0.0, 0.0, 0.0])
    poses = looking_at(ring.positions * [2, 1, 1], target)
    path = Ellipse(poses, 6.0)
    places, turns, fov = sampled(path, 601)
    np.testing.assert_allclose(places[:, 1], -1.5, rtol=0, atol=1e-9)
    assert np.abs(places).max(axis=0)[[0, 2]] == pytest.approx([6, 3], rel=0.03)
    np.testing.assert_allclose((places[:, [0, 2]] / np.abs(places).max(axis=0)[[0, 2]]) ** 2 @ [1, 1], 1, atol=1e-3)
    toward = target - places
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    np.testing.assert_allclose(turns[:, :, 2], toward, rtol=0, atol=1e-9)
    assert (-turns[:, :, 1] @ UP).min() > 0.8  # never upside down
    np.testing.assert_allclose(turns[:, :, 0] @ UP, 0, atol=1e-9)  # the horizon is level
    moved, turned = steps(places, turns)
    np.testing.assert_allclose(moved, moved.mean(), rtol=0.01)
    assert turned.max() < 0.05 and np.linalg.norm(places[0] - places[-1]) < 1e-9
    np.testing.assert_allclose(np.linalg.det(turns), 1)
    assert (fov == 40).all()


def test_the_ellipse_follows_a_tilted_plane_of_cameras():
    tilt = Rotation.from_euler("x", 20, degrees=True).as_matrix()
    path = Ellipse(looking_at(on_ring(40, height=0.0).positions @ tilt.T, np.zeros(3)), 3.0)
    places, turns, _ = sampled(path)
    assert np.abs(places @ tilt @ UP).max() < 1e-6
    assert (-turns[:, :, 1] @ UP).min() > 0.5


def test_the_ellipse_stays_within_the_arc_that_cameras_cover():
    for poses in (on_wall(), on_wall()[np.array([5, 9])], on_wall()[np.arange(5)], on_ring(40)[np.arange(-7, 7)]):
        path = Ellipse(poses, 5.0)
        places, turns, _ = sampled(path)
        reach = [np.linalg.norm(poses.positions - at, axis=1).min() for at in places]
        between = np.linalg.norm(np.diff(poses.positions, axis=0), axis=1).max()
        assert max(reach) < between + 0.1
        assert (-turns[:, :, 1] @ UP).min() > 0.5
        moved, turned = steps(places, turns)
        assert moved.max() < 0.2 and turned.max() < 0.1 and np.ptp(places, axis=0).max() > 0.5


def test_cameras_overhead_do_not_make_the_ellipse_spin():
    """A ring that passes over the focus, seen along the cameras' mean up."""
    angles = np.arange(24) * 2 * math.pi / 24
    ring = np.column_stack([np.sin(0.61) * np.cos(angles), np.full(24, -np.cos(0.61)), np.sin(0.61) * np.sin(angles)])
    poses = looking_at(4 * ring, np.zeros(3), up=Rotation.from_euler("x", 20, degrees=True).apply(UP))
    path = Ellipse(poses, 5.0)
    places, turns, _ = sampled(path)
    assert steps(places, turns)[1].max() < 0.05 and (-turns[:, :, 1] @ path.up).min() > 0


def test_the_spiral_turns_twice_before_the_scene():
    poses = on_wall()
    path = Spiral(poses, 4.0)
    places, turns, _ = sampled(path, 401)
    np.testing.assert_allclose(path.target, [0, 0, 4], atol=1e-9)
    np.testing.assert_allclose(np.abs(places).max(axis=0), path.radii, rtol=1e-3, atol=1e-9)
    assert path.radii == pytest.approx([1, 0.5, 0], abs=1e-9)
    np.testing.assert_allclose(places[0], places[-1], atol=1e-9)
    angle = np.unwrap(np.arctan2(places[:, 1] / 0.5, places[:, 0]))
    assert abs(angle[-1] - angle[0]) == pytest.approx(4 * math.pi)
    toward = (path.target - places) / np.linalg.norm(path.target - places, axis=1, keepdims=True)
    np.testing.assert_allclose(turns[:, :, 2], toward, atol=1e-9)
    assert (-turns[:, :, 1] @ UP).min() > 0.9


def test_the_spiral_looks_straight_ahead_where_axes_are_parallel():
    positions = on_wall().positions + np.random.default_rng(0).normal(0, 0.1, (15, 3))
    path = Spiral(Poses(positions, np.broadcast_to(np.eye(3), (15, 3, 3)), np.full(15, 40.0)), 4.0)
    places, turns, _ = sampled(path)
    np.testing.assert_allclose(turns, np.broadcast_to(np.eye(3), turns.shape), atol=1e-9)
    assert path.target is None and (np.abs(places - path.middle).max(axis=0) > 0.9 * path.radii).all()


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
    assert re.search("(take|as) --path( |$)", str(refused.value)) and "\n" not in str(refused.value)


@pytest.mark.parametrize("name", GENERATED)
def test_two_cameras_make_a_path(name):
    poses = looking_at(np.array([[-0.5, 0, 0], [0.5, 0, 0.1]]), np.array([0, 0, 4.0]))
    places, turns, _ = sampled(GENERATED[name](poses, 2.0))
    moved, turned = steps(places, turns)
    assert np.ptp(places[:, 0]) > 0.5 and moved.max() < 0.05 and turned.max() < 0.05


def test_far_from_the_origin_paths_are_the_same():
    """Cameras of a scene that kept its world: 1e4 extents away."""
    offset = np.array([3e4, -2e4, 1e4])
    oval = looking_at(on_ring(20).positions * [2, 1, 1], np.zeros(3))
    for name, poses in (("interpolate", oval), ("ellipse", oval), ("spiral", on_wall())):
        near = sampled(GENERATED[name](poses, 2.0), 50)
        far = sampled(GENERATED[name](Poses(poses.positions + offset, poses.turns, poses.fov), 2.0), 50)
        np.testing.assert_allclose(near[0] + offset, far[0], rtol=0, atol=1e-3)
        np.testing.assert_allclose(near[1], far[1], rtol=0, atol=1e-3)


def test_the_example_of_the_docs_is_read(tmp_path):
    page = Path(__file__).resolve().parents[1] / "docs" / "guide" / "videos.md"
    (tmp_path / "a.json").write_text(page.read_text(encoding="utf-8").split("```json\n")[1].split("```")[0])
    assert len(read_camera_path(tmp_path / "a.json").keyframes) >= 2
