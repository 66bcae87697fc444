"""The viewer's frames, and when they are drawn: no server, no browser."""

import argparse
import contextlib
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gaussians import model, parameters, pipeline
from scipy.spatial.transform import Rotation
from synthetic import options_of

from applications.viewer import legend, path_tab, views
from applications.viewer.coverage import Coverage, PointCoverage
from applications.viewer.divider import find_share
from applications.viewer.frames import LONGEST, Frame, Frames, find_inside, select_shown
from applications.viewer.page import write_crop
from applications.viewer.path_tab import PathTab
from applications.viewer.tabs import FileName
from applications.viewer.untrained import _make_spheres, load_untrained
from applications.viewer.views import Pose, SceneCameras, Settings, fit_canvas, fit_fov, read_pose
from applications.viewer.watchers import MOVING, STILL, STILL_AFTER, Budget, Watchers
from arguments import ModelParams
from gaussian_renderer import render
from gaussian_renderer.blending import count_list_entries
from gaussian_renderer.camera_paths.keyframes import read_camera_path
from gaussian_renderer.camera_paths.poses import poses_of
from gaussian_renderer.camera_paths.start import best_start
from gaussian_renderer.free_view import free_view
from gaussian_renderer.median_depth import surface_of
from scene import Scene
from scene.gaussian_model import GaussianModel
from scene.splats.reading import read_splats
from scene.with_splats import model_of
from utils.graphics_utils import camera_center
from utils.system_utils import UserError

FRONT = Pose((0.0, 0.0, -4.0), (1.0, 0.0, 0.0, 0.0), 0.8, 96, 64)
PLAIN = Settings()
BLACK = torch.zeros(3)


@pytest.fixture
def gaussians():
    return model(200)


@pytest.fixture(scope="module")
def scene_cameras(_colmap_master) -> SceneCameras:
    options = options_of(_colmap_master, "out", eval=True)
    scene = Scene(options, GaussianModel(0), shuffle=False, start=False)
    return SceneCameras(scene.getTrainCameras(), scene.getTestCameras())


def frame(gaussians, pose=FRONT, cameras=None, coarse=False, **settings) -> Frame:
    frames = Frames(gaussians, cameras or SceneCameras([], []), pipeline(), False)
    return frames.draw(replace(PLAIN, **settings), pose, coarse)


def drawn(*given, **settings) -> np.ndarray:
    return frame(*given, **settings).image


def rendered(gaussians, view=None, scaling=1.0, background=BLACK, **options) -> np.ndarray:
    """Our render (H, W, 3) uint8, from the front by default."""
    view = view or free_view(96, 64, FRONT.fov, FRONT.position, FRONT.wxyz, "cpu")
    with torch.no_grad():
        image = render(view, gaussians, pipeline(), background, scaling, **options)["render"]
    return (image * 255 + 0.5).to(torch.uint8).permute(1, 2, 0).numpy()


def at(camera, width=300, height=100) -> Pose:
    wxyz = Rotation.from_matrix(camera.R).as_quat(scalar_first=True)
    fov = fit_fov(camera, width / height)
    return Pose(tuple(camera_center(camera.R, camera.T)), tuple(wxyz), fov, width, height)


def test_a_frame_is_the_render_of_its_pose(gaussians):
    assert drawn(gaussians).std() > 10
    np.testing.assert_array_equal(drawn(gaussians), rendered(gaussians))
    red = drawn(gaussians, background=(1.0, 0.0, 0.0), scaling=0.5)
    np.testing.assert_array_equal(red, rendered(gaussians, scaling=0.5, background=torch.tensor([1.0, 0.0, 0.0])))
    # A moving camera gets a quarter of the pixels, and a large window not all.
    assert drawn(gaussians, coarse=True).shape == (32, 48, 3)
    assert drawn(gaussians, replace(FRONT, width=8000, height=40)).shape == (8, LONGEST, 3)


def test_modes_show_what_they_say(gaussians):
    white = rendered(gaussians, override_color=torch.ones(200, 3))
    np.testing.assert_array_equal(drawn(gaussians, mode=views.OPACITY), white)
    depth = drawn(gaussians, mode=views.DEPTH)
    assert not depth[white[..., 0] < 127].any() and depth[white[..., 0] > 128].any(axis=1).all()
    low = drawn(gaussians, sh_degree=0)
    gaussians.active_sh_degree = 0
    np.testing.assert_array_equal(low, rendered(gaussians))
    gaussians.active_sh_degree = 3
    # Without an image of the scene there is no error to show.
    np.testing.assert_array_equal(drawn(gaussians, mode=views.ERROR), rendered(gaussians))
    # The count of a pixel is that of its tile's list up to the last one blended.
    view = free_view(96, 64, FRONT.fov, FRONT.position, FRONT.wxyz, "cpu")
    counts = count_list_entries(view, gaussians, pipeline())
    with torch.no_grad():
        alpha = render(view, gaussians, pipeline(), BLACK, override_color=torch.ones(200, 3))["render"][0]
    assert torch.equal(counts > 0, alpha > 0) and 0 < counts.max() <= 200
    assert count_list_entries(view, model(1), pipeline()).max() == 1


def test_a_scale_names_the_depths_and_counts_of_its_colours(gaussians):
    distances = torch.linspace(2.0, 40.0, 2000).reshape(1, 20, 100)
    alpha = torch.full_like(distances, 0.8)
    alpha[0, 0, 0] = 0.4  # too thin to have a depth
    colours, scale = legend.color_depth(alpha / distances, alpha)
    assert not colours[:, 0, 0].any() and list(scale.numbers) == sorted(scale.numbers, reverse=True)
    assert scale.numbers[0] == pytest.approx(float(torch.quantile(distances, 0.98)), rel=0.01)
    for number, stop in zip(scale.numbers, legend._STOPS, strict=True):
        y, x = divmod(int((distances[0] - number).abs().argmin()), 100)
        np.testing.assert_allclose(colours[:, y, x], stop, atol=0.01)
    counts = torch.tensor([[0, 10, 20, 30, 40]])
    colours, scale = legend.color_counts(counts)
    assert scale.numbers == (0, 10, 20, 30, 40)
    np.testing.assert_allclose(colours[:, 0].T, legend._STOPS, atol=1e-6)
    assert "<span>40</span>" in scale.make_html()
    assert "<span>1,100</span>" in scale._replace(numbers=(1100.0,)).make_html()
    for mode in (views.DEPTH, views.COUNT):
        assert len(frame(gaussians, mode=mode).legend.numbers) == 5
    assert frame(gaussians).legend.make_html() == frame(gaussians, mode=views.OPACITY).legend.make_html() == ""


@pytest.mark.parametrize(("settings", "sides"), [
    ({"mode": views.ERROR}, ""),
    ({"comparison": views.SLIDER}, "Photo left of the line, render right"),
    ({"mode": views.DEPTH, "comparison": "Slider"}, "Photo left of the line, depth right"),
    ({"mode": views.ERROR, "comparison": "Side by side"}, "From the left: photo, error"),
])  # fmt: skip
def test_a_frame_that_lacks_its_photo_says_so(gaussians, scene_cameras, settings, sides):
    name, camera = next(iter(scene_cameras.by_name.items()))
    there = frame(gaussians, at(camera), scene_cameras, camera=name, **settings).legend
    away = frame(gaussians, FRONT, scene_cameras, camera=name, **settings).legend
    assert not there.warning and "No photo was taken from here" in away.make_html() and not away.sides
    assert there.sides == sides and (away.numbers == () or settings["mode"] == views.DEPTH)
    assert settings != {"mode": views.ERROR} or there.numbers[-1] == 51
    assert not frame(gaussians, FRONT, scene_cameras, camera=name).legend.make_html()


def test_the_crop_box_leaves_gaussians_out_and_the_model_alone(gaussians):
    before = {name: values.clone() for name, values in parameters(gaussians).items()}
    box = (1.0, 1.0, 0.0), (-1.0, -0.2, -1.0)  # opposite corners in any order
    x, y, z = gaussians.get_xyz.T
    keep = (x.abs() <= 1) & (y >= -0.2) & (y <= 1) & (z >= -1) & (z <= 0)
    assert 0 < keep.sum() < 200
    np.testing.assert_array_equal(drawn(gaussians, crop=box), rendered(gaussians.part(keep, 3)))
    assert len(gaussians) == 200 and gaussians.optimizer is not None
    assert all(torch.equal(values, before[name]) for name, values in parameters(gaussians).items())
    assert not drawn(gaussians, crop=((9.0,) * 3, (8.0,) * 3)).any()


def test_what_cleaning_leaves_and_what_it_takes_are_drawn_apart(gaussians):
    kept = torch.arange(200) % 3 > 0
    box = (-1.0, -0.2, -1.0), (1.0, 1.0, 0.0)
    for cleaning, part in ((views.STAYS, kept), (views.GOES, ~kept)):
        chosen = replace(PLAIN, cleaning=cleaning)
        assert torch.equal(select_shown(gaussians, chosen, kept).get_xyz, gaussians.get_xyz[part])
        both = select_shown(gaussians, replace(chosen, crop=box), kept).get_xyz
        assert torch.equal(both, gaussians.get_xyz[part & find_inside(gaussians.get_xyz, *box)])
        assert select_shown(gaussians, chosen) is gaussians  # nobody has cleaned
    assert select_shown(gaussians, PLAIN, kept) is gaussians


def _ahead(camera, x: float, y: float, z: float) -> torch.Tensor:
    """The point at slopes x and y, by those of the frame's corner, and at depth z."""
    inner = np.array([x * math.tan(camera.FoVx / 2), y * math.tan(camera.FoVy / 2), 1]) * z
    return torch.tensor(camera_center(camera.R, camera.T) + np.asarray(camera.R) @ inner, dtype=torch.float32)


def test_what_a_training_view_showed_from_there_is_covered(scene_cameras):
    camera = next(iter(scene_cameras.by_name.values()))
    places = [(0, 0, 2), (0.98, -0.98, 3), (1.4, 0, 3), (0, -1.4, 3), (0, 0, -2)]
    points = torch.stack([_ahead(camera, *place) for place in places])
    covered = PointCoverage(points, [camera]).measure(camera.camera_center)
    torch.testing.assert_close(covered, torch.tensor([1.0, 1, 0, 0, 0]), atol=1e-4, rtol=0)
    middle = _ahead(camera, 0, 0, 3)
    for degrees, share in ((20, 1.0), (38, 0.55), (55, 0.0), (180, 0.0)):
        turn = torch.tensor(Rotation.from_rotvec(np.radians(degrees) * np.asarray(camera.R)[:, 1]).as_matrix()).float()
        eye = middle + turn @ (camera.camera_center - middle)
        assert float(PointCoverage(middle[None], [camera]).measure(eye)) == pytest.approx(share, abs=0.05), degrees
    some = torch.stack([_ahead(camera, x, 0, 3) for x in (0.0, 0.5, 3, -3)])
    guesses = Coverage([camera], scene_cameras.size).guesses(some, camera.camera_center)[:, 0]
    torch.testing.assert_close(guesses, torch.tensor([0.0, 0, 1, 1]), atol=0.02, rtol=0)


def _surface(places: list, size: float, ray: np.ndarray):
    """The surface that a frame finds along a ray, and its Gaussians: round ones of a size at places."""
    gaussians = model_of(_make_spheres(np.float32(places), np.ones((len(places), 3), np.float32), size))
    return Frames(gaussians, SceneCameras([], []), pipeline(), False).surface(PLAIN, FRONT, ray), gaussians


def test_the_surface_along_a_ray_is_found_where_there_is_one_also_far_from_the_mean_of_a_large_gaussian():
    ahead, ray = np.array([0.0, 0, 1]), np.array([0.5, -0.2, 4]) / np.linalg.norm([0.5, -0.2, 4])
    np.testing.assert_allclose(_surface([[0.5, -0.2, 0]], 0.05, ray)[0], [0.5, -0.2, 0], atol=1e-3)
    assert _surface([[0.5, -0.2, 0]], 0.05, ahead)[0] is None
    found, gaussians = _surface([[4 * np.tan(np.radians(10)), 0, 0]], 1.0, ahead)
    np.testing.assert_allclose(found, 0)
    beside = free_view(17, 17, np.radians(10), FRONT.position, FRONT.wxyz, "cpu")  # its mean is not in this view
    assert float(surface_of(beside, gaussians, pipeline()).depth[8, 8]) == pytest.approx(4)


def test_guesses_are_dark_and_photos_are_not(gaussians, scene_cameras):
    camera = next(iter(scene_cameras.by_name.values()))
    frames = Frames(gaussians, scene_cameras, pipeline(), False)
    frames.coverage = Coverage([camera], scene_cameras.size)
    there = at(camera, camera.image_width, camera.image_height)
    place = 2 * _ahead(camera, 0, 0, 4).numpy() - camera_center(camera.R, camera.T)
    half_turn = Rotation.from_matrix(np.asarray(camera.R) @ np.diag([-1.0, 1, -1])).as_quat(scalar_first=True)
    behind, away = replace(there, position=tuple(place), wxyz=tuple(half_turn)), replace(there, position=(9e3,) * 3)
    for pose, share in ((there, 1.0), (behind, 0.12)):
        plain, dark = (frames.draw(replace(PLAIN, darken=on), pose, False).image.astype(float) for on in (False, True))
        assert plain.max() > 50 and (dark <= plain).all()
        assert dark.sum() == pytest.approx(share * plain.sum(), rel=0.25)  # some is background
    red = frames.draw(replace(PLAIN, darken=True, background=(1.0, 0.0, 0.0)), away, False)
    assert (red.image == (255, 0, 0)).all()  # where no Gaussian is, nothing is guessed


@pytest.mark.parametrize("size", [(300, 100), (96, 64), (60, 200)])
def test_left_of_the_slider_is_the_scenes_image_and_right_of_it_the_render(gaussians, scene_cameras, size):
    name, camera = next(iter(scene_cameras.by_name.items()))
    shown = drawn(gaussians, at(camera, *size), scene_cameras, camera=name, comparison=views.SLIDER, slider=0.25)
    wide, high = fit_canvas(96, 64, size[0] / size[1])
    top, left = (high - 64) // 2, (wide - 96) // 2
    assert shown.shape == (high, wide, 3)
    inner = shown[top : top + 64, left : left + 96]
    np.testing.assert_array_equal(inner[:, :24], camera.target(BLACK).permute(1, 2, 0).numpy()[:, :24])
    np.testing.assert_array_equal(inner[:, 24:], rendered(gaussians, camera)[:, 24:])
    assert find_share((left + 24) / wide, camera, wide, high) == pytest.approx(0.25)
    assert find_share(-0.1, camera, *size) == 0 and find_share(1.0, camera, *size) == 1


def test_side_by_side_are_image_render_and_error(gaussians, scene_cameras):
    name, camera = next(iter(scene_cameras.by_name.items()))
    shown = drawn(gaussians, at(camera), scene_cameras, camera=name, comparison=views.BESIDE).astype(int)
    top, left = (shown.shape[0] - 64) // 2, (shown.shape[1] - 3 * 96) // 2
    target, image, error = np.split(shown[top : top + 64, left : left + 3 * 96], 3, axis=1)
    assert abs(error - np.minimum(abs(target - image) * 5, 255)).max() <= 4  # rounded before the difference
    for mode, sides in ((views.COLOUR, "photo, render, error"), (views.DEPTH, "photo, depth")):
        words = frame(gaussians, at(camera), scene_cameras, camera=name, comparison=views.BESIDE, mode=mode).legend
        assert f"left: {sides}</div>" in words.make_html()
        assert words.numbers[-1] == 51 if mode == views.COLOUR else words.numbers != legend.ERROR_SCALE.numbers
    alone = drawn(gaussians, at(camera), scene_cameras, camera=name, mode=views.ERROR).astype(int)
    assert abs(alone[:64, (alone.shape[1] - 96) // 2 :][:, :96] - error).max() <= 1


def test_an_image_is_shown_only_where_it_was_taken_and_drawn_once(gaussians, scene_cameras, monkeypatch):
    name, camera = list(scene_cameras.by_name.items())[3]
    frames, pose = Frames(gaussians, scene_cameras, pipeline(), False), at(camera)
    asked = replace(PLAIN, camera=name, comparison=views.SLIDER)
    assert frames.compared(asked, pose) is camera
    moved = tuple(np.asarray(pose.position) + [0.02 * scene_cameras.size, 0, 0])
    turned = Rotation.from_matrix(camera.R) * Rotation.from_rotvec([0, 0.005, 0])
    for other in (replace(pose, position=moved), replace(pose, wxyz=tuple(turned.as_quat(scalar_first=True)))):
        assert frames.compared(asked, other) is None
    for change in ({"camera": "no such"}, {"comparison": views.ALONE}):
        assert frames.compared(replace(asked, **change), pose) is None
    calls = []
    monkeypatch.setattr("applications.viewer.frames.render", lambda *a, **k: (calls.append(1), render(*a, **k))[1])
    for slider, version in ((0.1, 1), (0.2, 1), (0.9, 1), (0.9, 2)):
        frames.draw(replace(asked, slider=slider), pose, False, version)
    assert len(calls) == 2  # until the model changes
    plain = frames.draw(replace(asked, slider=1.0), pose, False, 3).image.astype(int)
    frames.masks = lambda of: torch.zeros(1, of.image_height, of.image_width, dtype=torch.bool)
    masked = frames.draw(replace(asked, slider=1.0), pose, False, 4).image
    assert (plain - masked).max() > 50 and (masked <= plain).all()


@pytest.mark.parametrize("aspect", [0.46, 1.0, 1.6])
def test_a_view_of_all_cameras_has_them_all_in_its_window(scene_cameras, aspect):
    place, axes, target = scene_cameras.overview()
    places = [camera_center(camera.R, camera.T) for camera in scene_cameras.by_name.values()]
    inner = (np.array([*places, target]) - place) @ axes
    slope = math.tan(views.overview_fov(aspect) / 2)
    across, high = np.abs(inner[:, :2] / inner[:, 2:]).max(0) / (aspect * slope, slope)
    assert (inner[:, 2] > 0).all() and max(across, high) <= 0.8 + 1e-9 and across > 0.05
    assert axes[:, 2] @ scene_cameras.up == pytest.approx(-math.sin(math.radians(35)))  # from above


def test_a_page_begins_at_the_camera_that_an_exported_one_begins_at(scene_cameras):
    train = [camera for name, camera in scene_cameras.by_name.items() if name.startswith("train")]
    assert scene_cameras.by_name[scene_cameras.start] is train[best_start(poses_of(train))]
    assert SceneCameras([], []).start == ""


@pytest.fixture
def clock() -> SimpleNamespace:
    return SimpleNamespace(now=100.0)


@pytest.fixture
def watchers(clock) -> Watchers:
    return Watchers(lambda: clock.now)


@pytest.mark.parametrize("share", [STILL, MOVING])
@pytest.mark.parametrize("cost", [0.001, 0.05, 2.0])
def test_frames_take_no_more_than_their_share_of_the_time(share, cost):
    clock, count = SimpleNamespace(now=100.0), 0
    budget = Budget(lambda: clock.now)
    while clock.now < 160:
        clock.now += 0.004
        if budget.allows_frame(share):
            began = clock.now
            clock.now += cost
            budget.note_frame(began, cost)
            count += 1
    assert count * cost <= share * 60 + cost and count <= 30 * 60 + 1
    assert count * cost >= 0.8 * min(share * 60, 25 * 60 * cost)  # nor much less than may be taken


def test_a_browser_that_moves_gets_coarse_frames_and_then_a_sharp_one(clock, watchers):
    assert not watchers.any and watchers.next() is None
    watchers.update_browser(7, FRONT)
    first = watchers.next()
    assert watchers.any and first.urgent and not first.coarse
    watchers.update_browser(7, replace(FRONT, fov=0.9))
    watchers.note_drawing(first)
    assert watchers.next().pose.fov == 0.9  # it moved while the frame was drawn
    clock.now += 1
    watchers.update_browser(7, replace(FRONT, fov=0.7))
    for wait, coarse in ((0, True), (STILL_AFTER + 0.01, False)):
        clock.now += wait
        wish = watchers.next()
        assert wish.coarse == coarse and wish.urgent and wish.pose.fov == 0.7
        watchers.note_drawing(wish)
        assert watchers.next() is None
    watchers.remove_browser(7)
    assert not watchers.any


def test_a_model_that_changes_is_shown_to_all_who_look_and_nobody_waits_for_it(clock, watchers):
    for client in (1, 2):
        watchers.update_browser(client, FRONT)
        watchers.note_drawing(watchers.next(5), 5)
        clock.now += 1
    assert watchers.next(5) is None
    wish = watchers.next(6)
    assert wish.client == 1 and not wish.urgent and not wish.coarse
    watchers.note_drawing(wish, 6)
    assert watchers.next(6).client == 2
    watchers.update_browser(1, replace(FRONT, fov=0.1))
    assert watchers.next(6).client == 1  # who waits comes first
    watchers.note_drawing(watchers.next(6), 6)
    watchers.note_change()
    assert watchers.next(6).urgent


def test_what_a_browser_sends_is_checked():
    sound = {"position": [1, 2, 3], "wxyz": [2, 0, 0, 0], "fov": 1.0, "image_width": 800, "image_height": 600}
    read = lambda **change: read_pose(SimpleNamespace(**sound | change))  # noqa: E731
    assert read() == Pose((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0), 1.0, 800, 600)
    assert read(wxyz=[0, 0, 0, 0]) is read(wxyz=[1e18, 0, 0, 0]) is None
    assert [fov for fov in (0.0, math.pi, -1.0) if read(fov=fov)] == []
    for width, height in ((10**9, 10**9), (10**9, 1), (0, 0), (-5, 10**6)):
        pose = read(image_width=width, image_height=height)
        assert 1 <= pose.width <= 8192 and 1 <= pose.height <= 8192 and 0.09 < pose.width / pose.height < 11


class Gui:
    """A stand-in for viser's controls."""

    def __getattr__(self, name: str):
        def add(label: str, *values: object, **_: object) -> SimpleNamespace:
            first = values[0] if values else None
            control = {"on_click": lambda call: None, "on_update": lambda call: None, "visible": True}
            if name == "add_dropdown":
                control |= {"options": first, "value": first[0]}
            return SimpleNamespace(**{"value": first} | control)

        return add


@pytest.fixture
def server() -> SimpleNamespace:
    return SimpleNamespace(gui=Gui(), get_clients=lambda: {7: "a browser"})


@pytest.fixture
def recorded(server, tmp_path, scene_cameras) -> PathTab:
    tab = PathTab(server, tmp_path / "paths", scene_cameras, lambda client, error: None)
    tab.easing.value = "smooth"
    return tab


def _client(**changes: object) -> SimpleNamespace:
    camera = {"position": [1, 2, 3], "wxyz": [0, 1, 0, 0], "fov": 1.0, "image_width": 4, "image_height": 3}
    return SimpleNamespace(camera=SimpleNamespace(**camera | changes), atomic=contextlib.nullcontext, client_id=7)


def test_a_recorded_path_is_read_by_what_renders_it(recorded, tmp_path):
    recorded.file.field.value = "fly_1-a"
    assert all(button.disabled for button in (recorded.play, recorded.saved, *recorded._of_one, recorded._of_file))
    recorded.add(_client())
    with pytest.raises(UserError, match="at least 2 keyframes"):
        recorded.save()
    assert not any(button.disabled for button in recorded._of_one) and recorded.saved.disabled
    recorded.seconds.value = 1.5
    recorded.add(_client(position=[4, 5, 6]))
    assert not (recorded.play.disabled or recorded.saved.disabled) and recorded._of_file.disabled
    recorded.add(_client(fov=0.0))  # cannot be drawn, so is no keyframe
    path = read_camera_path(recorded.save())
    assert path.seconds == 1.5 and path.easing == "smooth"
    assert [key.position for key in path.keyframes] == [(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)]
    assert math.isclose(path.keyframes[0].fov, math.degrees(1.0)) and path.keyframes[0].wxyz == (0.0, 1.0, 0.0, 0.0)
    assert [file.name for file in tmp_path.rglob("*.json")] == ["fly_1-a.json"]
    (tmp_path / "paths/a b.json").touch()  # a name that the page does not take
    recorded.list_files()
    recorded.keyframes, recorded.easing.value, recorded.file.field.value = [], "linear", "other"
    recorded.files.value = recorded.files.options[0]  # as viser does by itself
    recorded.open(client := _client())
    assert tuple(recorded.keyframes) == path.keyframes and recorded.easing.value == "smooth"
    assert not recorded._of_file.disabled and client.camera.position[0] == 1
    assert recorded.files.options == ("fly_1-a",) == (recorded.file.field.value,)


def test_keyframes_are_listed_gone_to_and_deleted_anywhere(recorded, monkeypatch):
    for call in (recorded.move_to_keyframe, recorded.delete, recorded.open):
        with pytest.raises(UserError, match="no keyframe is chosen|no such path"):
            call(_client())
    for x in (1.0, 2.0, 3.0, 4.0):
        recorded.add(_client(position=[x, 0, 0]))
    assert recorded.chosen.options == ("1: at 0 s", "2: at 2 s", "3: at 4 s", "4: at 6 s")
    assert recorded.chosen.value == "4: at 6 s"
    recorded.chosen.value = "2: at 2 s"
    recorded.move_to_keyframe(client := _client(fov=0.3))
    assert client.camera.position.tolist() == [2.0, 0.0, 0.0] and math.isclose(client.camera.fov, 1.0)
    assert client.camera.look_at[2] < 0 and client.camera.up_direction[1] > 0  # wxyz is half a turn about x
    for chosen, options, places in (
        ("2: at 2 s", ("1: at 0 s", "2: at 4 s", "3: at 6 s"), [1, 3, 4]),
        ("1: at 0 s", ("1: at 0 s", "2: at 2 s"), [3, 4]),  # a path begins at 0
    ):
        recorded.chosen.value = chosen
        recorded.delete(client := _client())
        assert recorded.chosen.options == options and recorded.chosen.value in options
        assert [key.position[0] for key in recorded.keyframes] == places
        assert client.camera.position[0] == places[options.index(recorded.chosen.value)]
    monkeypatch.setattr(path_tab, "_MOST", 3)
    recorded.add(_client())
    with pytest.raises(UserError, match="at most 3 keyframes"):
        recorded.add(_client())


def test_no_name_leads_out_of_the_folder(server, tmp_path):
    file = FileName(server, tmp_path, "crop", ".ply")
    assert file.path() == tmp_path / "crop1.ply"
    for name in ("", "..", "../a", "a/b", "a\\b", "/etc/x", "a.json", "a\0b", "ä", "a\n", "x" * 65):
        file.field.value = name
        with pytest.raises(UserError, match="choose another one"):
            file.path()
    (tmp_path / "crop1.ply").touch()
    assert FileName(server, tmp_path, "crop", ".ply").path() == tmp_path / "crop2.ply"


def test_a_crop_is_written_as_any_program_reads_it(gaussians, tmp_path):
    gaussians.active_sh_degree, gaussians.world_offset = 1, (10.0, 20.0, 30.0)
    box = (0.5, 0.4, 0.3), (-0.5, -0.4, -2.0)
    keep = find_inside(gaussians.get_xyz, *box)
    assert 0 < write_crop(tmp_path / "a/crop.ply", gaussians, box, antialiasing=True) == keep.sum() < 200
    splats = read_splats(tmp_path / "a/crop.ply")
    np.testing.assert_array_equal(splats.means, gaussians.get_xyz[keep].detach())
    assert splats.sh_degree == 1 and splats.antialiasing and splats.world_offset == gaussians.world_offset
    with pytest.raises(UserError, match="no Gaussians; move its corners"):
        write_crop(tmp_path / "b.ply", gaussians, ((9.0,) * 3, (8.0,) * 3), antialiasing=False)
    assert not (tmp_path / "b.ply").exists()


def test_points_are_gaussians_of_their_places_and_cameras_have_photos(colmap_scene):
    parser = argparse.ArgumentParser()
    params = ModelParams(parser, sentinel=True)
    scene = load_untrained(params.extract(parser.parse_args(["-s", str(colmap_scene)])))
    points = scene.info.point_cloud.points
    assert np.allclose(scene.gaussians.get_xyz.detach().cpu().numpy(), points, atol=1e-5)
    assert float(scene.gaussians.get_scaling.max()) < 0.01 * scene.cameras_extent
    assert scene.getTrainCameras()[0].target((0.0, 0.0, 0.0)).float().std() > 0
