"""The viewer's server: who may connect, what a request can reach, and the page over a websocket."""

import contextlib
import http.client
import json
import math
import socket
import sys
from collections.abc import Callable

import numpy as np
import pytest
from gaussians import model, pipeline
from synthetic import options_of

viser = pytest.importorskip("viser", reason="viser is not installed: pip install '.[viewer]'")

import msgspec  # noqa: E402
from viser_client import Client, get  # noqa: E402
from waiting import wait_for  # noqa: E402
from websockets.exceptions import InvalidStatus  # noqa: E402

from applications.viewer import server as servers  # noqa: E402
from applications.viewer import watchers  # noqa: E402
from applications.viewer.measure_tab import Place  # noqa: E402
from applications.viewer.page import Page, answer  # noqa: E402
from applications.viewer.tabs import find_first_box  # noqa: E402
from applications.viewer.untrained import _make_spheres  # noqa: E402
from applications.viewer.views import Settings  # noqa: E402
from gaussian_renderer.camera_paths.start import LEAST, MOST  # noqa: E402
from gaussian_renderer.camera_paths.without_scene import WithoutScene, circle_cameras  # noqa: E402
from groundwork.files.similarity import Similarity, read_orientation, recorded_similarity  # noqa: E402
from scene import Scene  # noqa: E402
from scene.with_splats import model_of  # noqa: E402
from utils.graphics_utils import camera_center  # noqa: E402
from utils.system_utils import UserError  # noqa: E402

ANY = 0


class Served:
    """A server for a block. port, url: where it listens."""

    def __init__(self, port: int = ANY) -> None:
        self.server, self.url = servers.serve(port, "test")
        self.port = self.server.get_port()

    def __enter__(self) -> "Served":
        return self

    def __exit__(self, *_: object) -> None:
        servers.stop(self.server)


def _set(client: Client, handle: object, value: object) -> None:
    client.send("GuiUpdateMessage", uuid=handle._impl.uuid, updates={"value": value})


def _button(page: Page, label: str) -> object:
    return next(h for h in page.server.gui._gui_input_handle_from_uuid.values() if getattr(h, "label", "") == label)


@contextlib.contextmanager
def _restored(page: Page):
    """The page, whose controls get their values back."""
    controls = page.server.gui._gui_input_handle_from_uuid.values()
    before = [(handle, handle.value) for handle in controls if not handle._impl.is_button]
    yield
    for handle, value in before:
        handle.value = value


@pytest.fixture(scope="module")
def local():
    with Served() as served:
        yield served


def test_no_request_reads_a_file_but_the_page(local):
    page = get(local.port, "/")[2]
    for path in (
        "/../../etc/passwd", "/..%2f..%2f..%2fetc/passwd", "/%2e%2e/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd",
        "/..\\..\\etc\\passwd", "/%252e%252e/etc/passwd", "/etc/passwd%00", "http://127.0.0.1/../../etc/passwd",
        "/assets/../../../_viser.py",
    ):  # fmt: skip
        with contextlib.suppress(http.client.HTTPException, OSError):  # closed without an answer
            status, _, body = get(local.port, path)
            assert (status != 200 or body == page) and b"root:" not in body and b"import " not in body[:2000], path


def test_other_sites_that_a_browser_has_open_reach_nothing(local):
    """Not by a websocket from their own origin, nor through a name of theirs that leads to 127.0.0.1."""
    port = local.port
    for host, status in (
        (f"127.0.0.1:{port}", 200), ("localhost:9999", 200), ("[::1]:1", 200), ("localhost", 200),
        ("evil.example", 403), (f"evil.example:{port}", 403), ("127.0.0.1.evil.example", 403), ("", 403), ("[", 403),
        (":80", 403), ("127.0.0.1:x", 403), ("localhost@evil.example", 403), ("127.0.0.1 evil.example", 403),
    ):  # fmt: skip
        assert get(port, "/", Host=host)[0] == status, host
    for origin in (local.url.rstrip("/"), None):
        with Client(local.url, origin) as client:
            assert client.messages()
    for origin in ("http://evil.example", f"http://evil.example:{port}", "null", "http://127.0.0.1:1"):
        with pytest.raises(InvalidStatus, match="403"):
            Client(local.url, origin)


def test_a_taken_port_is_passed_over_and_told(capfd):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with Served(port) as served:
            assert served.port > port
    assert capfd.readouterr().err == f"viewer: http://127.0.0.1:{served.port}/ (port {port} is taken)\n"
    with contextlib.ExitStack() as taking:
        with contextlib.suppress(OSError):  # another program may have it already
            taking.enter_context(socket.create_server(("127.0.0.1", 65535)))
        for port, said in ((65535, "port 65535 .* taken"), (70_000, "between 0 .any. and 65535, got 70000")):
            with pytest.raises(UserError, match=said):
                servers.check_port(port)


def test_without_viser_a_sentence_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(UserError, match=f"pip install {servers.VISER}"):
        servers.check_port(8080)
    servers.check_port(None)


CLICK = {
    "type": "SceneNodeClickMessage", "name": "/cameras", "instance_index": None, "ray_origin": [0, 0, 0],
    "ray_direction": [0, 0, 1], "screen_pos": [0.5, 0.5], "modifier": None, "owner": "",
}  # fmt: skip


@pytest.fixture(scope="module")
def _page(_colmap_master, tmp_path_factory):
    """A page whose model and first photo have names that are not UTF-8."""
    options = options_of(_colmap_master, tmp_path_factory.mktemp("page") / "a\udcff", eval=True)
    scene = Scene(options, model(200), shuffle=False, start=False)
    scene.getTrainCameras()[0].image_name = "b\udcff.png"
    shown = Page(ANY, scene, pipeline(), False, False)
    yield shown
    shown.stop()


@pytest.fixture
def page(_page):
    """The page, which the browsers of a test leave before the next one begins."""
    yield _page
    wait_for(lambda: not _page.watchers.any)


def _answered(page: Page, client: Client):
    """The picture that a client gets when it is the page's turn."""
    wait_for(lambda: answer(page))
    return client.picture()


def test_each_browser_gets_pictures_of_its_own_camera(page, monkeypatch):
    monkeypatch.setattr(watchers, "STILL_AFTER", 3600.0)  # seconds, so that no machine is too slow to see a movement
    with Client(page.url) as one, Client(page.url) as other:
        one.look(size=(120, 80))
        first = _answered(page, one)
        assert first.shape == (160, 240, 3) and first.std() > 5
        other.look((0.5, 0.0, -4.0), size=(60, 60))
        assert _answered(page, other).shape == (120, 120, 3)
        one.look((1.5, 0.0, -4.0), size=(120, 80))
        assert _answered(page, one).shape == (40, 60, 3)  # coarse while it moves


@pytest.mark.parametrize("wrong", [
    {"size": (0, 0)}, {"size": (-5, 1e18)}, {"position": (0.0, 0.0, 0.0)}, {"position": (1e18, 0.0, 0.0)},
], ids=["no window", "an endless window", "at what it looks at", "far away"])  # fmt: skip
def test_a_browser_of_any_window_and_place_goes_to_a_camera(page, capfd, wrong):
    cameras, heard = page.images._cameras.by_name, {}
    name, *_, page.images.camera.value = cameras
    with Client(page.url) as client:
        client.look(**wrong)
        wait_for(page.server.get_clients)
        _set(client, page.images.camera, name)
        while not {"SetCameraPositionMessage", "SetCameraFovMessage"} <= heard.keys():
            heard |= {message["type"]: message for message in client.messages() if not message.get("initial")}
    place = camera_center(cameras[name].R, cameras[name].T)
    assert heard["SetCameraPositionMessage"]["position"] == pytest.approx(place)
    assert 0 < heard["SetCameraFovMessage"]["fov"] < math.pi and "Traceback" not in capfd.readouterr().err


def test_a_frame_that_cannot_be_drawn_is_told_once_until_one_can_and_ends_nothing(page, monkeypatch, capfd):
    def broken(*_: object) -> None:
        raise OSError("no file a\udcff.png")

    with Client(page.url) as client:
        client.look(size=(60, 60))
        for told in (1, 2):
            with monkeypatch.context() as patched:
                patched.setattr(page.frames, "draw", broken)
                for step in (1.0, 2.0):
                    client.look((step, 0.0, -4.0), size=(60, 60))
                    wait_for(lambda: answer(page))
            assert "no file a\\udcff.png" in client.until("NotificationShowMessage")["props"]["body"]
            client.look((0.0, 0.0, -4.0), size=(60, 60))
            assert _answered(page, client).shape[2] == 3
            assert capfd.readouterr().err.count("could not draw a frame (no file") == 1, told


def test_a_crop_is_written_into_the_models_folder_and_nowhere_else(page, capfd):
    view, folder = page.view, page.view.crop_file.folder
    with Client(page.url) as client, _restored(page):
        client.look()
        for name, replaced in (("../../outside", False), ("mine", False), ("mine", True)):  # test_viewer.py has more
            _set(client, view.crop_file.field, name)
            for ends in view.box:
                _set(client, ends, [-0.5, 0.5])
            _set(client, _button(page, "Export the crop"), True)
            wait_for(lambda: page.requests.any)
            assert view.crop_file.field.value == name
            answer(page)
            assert not page.requests.any
            heard = client.until("NotificationShowMessage")["props"]
            assert heard["title"] == ("Exported" if name == "mine" else "Not exported")
            assert heard["color"] == (None if name == "mine" else "red") and heard["body"].endswith(")") == replaced
            assert 0 < heard["auto_close_seconds"] < 60  # so that messages do not pile up
    assert folder.parent.name == "a\udcff" and [file.name for file in folder.iterdir()] == ["mine.ply"]
    assert not list(folder.parent.parent.rglob("outside*"))
    said = capfd.readouterr()
    assert said.err.count("warning: the crop is not exported") == 1 and "of 200 Gaussians to" in said.out


def test_reset_gives_the_view_its_first_values(page):
    view, first = page.view, Settings(sh_degree=3, darken=True)
    assert view.reset.disabled
    view.mode.value, view.scaling.value, view.background.value = "Depth", 0.3, (9, 9, 9)
    view.crop.value, view.box[0].value = True, (7.0, 7.0)
    wait_for(lambda: view.crop_file.field.visible and not view.reset.disabled)
    with Client(page.url) as client:
        client.look()
        _set(client, _button(page, "Reset"), True)
        wait_for(lambda: view.read() == first and not view.crop_file.field.visible and view.reset.disabled)
    assert view.corners() == find_first_box(page._gaussians.get_xyz)


def test_without_photos_nothing_is_compared_with_them(tmp_path):
    cameras = circle_cameras(np.float32([[0, 0, 0], [1, 1, 1]]))
    shown = Page(ANY, WithoutScene(model(5), str(tmp_path), "a.ply", cameras), pipeline(), False, False)
    assert shown.images.comparison.disabled and "Error" not in shown.view.mode.options
    shown.stop()


def test_browsers_begin_at_the_chosen_camera_and_render_alone_leads_nowhere(page):
    images, cameras = page.images, page.images._cameras.by_name
    name = list(cameras)[5]
    place = camera_center(cameras[name].R, cameras[name].T)
    with Client(page.url) as client, _restored(page):
        client.look()
        wait_for(page.server.get_clients)
        _set(client, images.camera, name)
        wait_for(lambda: np.allclose(page.server.initial_camera.position, place))
        _set(client, images.comparison, "Slider")
        wait_for(lambda: images.slider.visible)
        client.look((7.0, 7.0, 7.0))
        wait_for(lambda: next(iter(page.server.get_clients().values())).camera.position[0] == 7.0)
        _set(client, images.comparison, "Render alone")
        _set(client, page.view.mode, "Depth")  # it is heard after that
        wait_for(lambda: page.view.mode.value == "Depth")
        assert not images.slider.visible
        assert next(iter(page.server.get_clients().values())).camera.position[0] == 7.0


def _fov(client: Client) -> float:
    message = {"initial": True}  # what the page begins with, without a window
    while message.get("initial"):
        message = client.until("SetCameraFovMessage")
    return message["fov"]


def test_a_browser_begins_with_most_of_a_photos_height_in_windows_of_any_shape(page):
    camera = page.images._cameras.by_name[page.images.camera.value]
    wxyz = viser.transforms.SO3.from_matrix(np.asarray(camera.R)).wxyz
    place, photo = camera_center(camera.R, camera.T), math.tan(camera.FoVy / 2)
    with Client(page.url) as client:
        client.look(size=(96, 64))  # at the browser's own beginning, before it hears of the page's
        for size, heights in (((956, 300), LEAST), ((390, 844), MOST), ((96, 64), 1)):
            client.look(place, wxyz, size=size)
            assert math.tan(_fov(client) / 2) / photo == pytest.approx(heights, rel=1e-3)
        client.look(place, wxyz, fov=0.3)  # the same window: what somebody has set stays
        client.look(place + 1.0, wxyz, size=(500, 100))  # not where it began
        client.look(place, wxyz, size=(50, 100))
        assert math.tan(_fov(client) / 2) / photo == pytest.approx(MOST, rel=1e-3)


def test_the_line_between_photo_and_render_is_dragged_where_both_are_shown(page):
    images = page.images
    camera = images._cameras.by_name[images.camera.value]
    place, wxyz = camera_center(camera.R, camera.T), viser.transforms.SO3.from_matrix(np.asarray(camera.R)).wxyz
    with Client(page.url) as client, _restored(page):
        client.look(place, wxyz, size=(192, 64))
        wait_for(page.server.get_clients)
        assert not images._divider._drawn
        _set(client, images.comparison, "Slider")
        wait_for(lambda: images._divider._drawn)
        (line,) = images._divider._drawn.values()

        def across() -> float:  # of the camera's axis; another thread draws the line, and moves it after the slider
            x, _, z = (np.asarray(line.position) - place) @ np.asarray(camera.R)
            return x / z if z > 0 else math.nan

        wait_for(lambda: line.visible and across() == pytest.approx(0, abs=1e-6))
        drag = {"name": "/divider", "instance_index": None, "button": "left", "modifier": None}
        drag |= {"start_position": [0] * 3, "end_position": [0] * 3}
        drag |= {"start_screen_pos": [0.5, 0.5], "end_screen_pos": [0.625, 0.5]}
        for phase in ("start", "update"):
            client.send("SceneNodeDragMessage", **drag, phase=phase, owner=line._impl.api._owner_id)
        wait_for(lambda: images.slider.value == pytest.approx(0.75))  # the photo has half of the window's width
        wait_for(lambda: across() == pytest.approx(0.5 * math.tan(camera.FoVx / 2), rel=1e-3))
        client.look(place + 0.1, wxyz, size=(192, 64))
        wait_for(lambda: not line.visible)
    wait_for(lambda: not images._divider._drawn)


def test_cameras_near_a_browser_are_not_drawn_and_a_click_on_another_leads_there(page):
    frusta, cameras = page.images.frusta, page.images._cameras.by_name
    with Client(page.url) as client, _restored(page):
        places = [camera_center(camera.R, camera.T) for camera in cameras.values()]
        client.look(places[0])
        wait_for(lambda: frusta._drawn)
        (drawn,) = frusta._drawn.values()
        wait_for(lambda: drawn.batched_opacities[0] == 0)
        assert not drawn.batched_scales[0].any() and drawn.batched_opacities.max() == 1
        client.look(places[3])
        wait_for(lambda: drawn.batched_opacities[3] == 0 and drawn.batched_scales[0].all())
        for index in (None, -1, 10**6, 2):
            click = CLICK | {"instance_index": index, "owner": drawn._impl.api._owner_id}
            client._socket.send(msgspec.msgpack.encode(click))
        wait_for(lambda: page.images.camera.value == list(cameras)[2])
        page.images.camera.value = next(iter(cameras))
    wait_for(lambda: not frusta._drawn)


def test_a_path_is_saved_with_the_command_of_its_video_and_what_fails_is_red(page, capfd):
    with Client(page.url) as client, _restored(page):
        client.look(size=(121, 80))
        _set(client, page.path.saved, True)
        told = client.until("NotificationShowMessage")["props"]
        assert told["color"] == "red" and "at least 2 keyframes" in told["body"]
        for number in (1, 2):
            _set(client, _button(page, "Add this view"), True)
            wait_for(lambda number=number: len(page.path.keyframes) == number)
        _set(client, page.path.saved, True)
        assert client.until("NotificationShowMessage")["props"]["title"] == "Saved"
    assert capfd.readouterr().out.strip().endswith("camera_paths/path1.json' --size 120 80")


def test_clicked_points_measure_and_are_kept_as_the_scenes_orientation(tmp_path, capsys):
    places = np.float32([[-1, 0.5, 0], [1, 0.5, 0], [0, 0.5, 2], [0, -0.5, 1]])
    out, scene = tmp_path / "out", tmp_path / "scene"
    scene.mkdir(), out.mkdir(), (out / "model.json").write_text("{}")
    gaussians = model_of(_make_spheres(places, np.ones((4, 3), np.float32), 0.05))
    gaussians.world_offset = (10.0, 0.0, 0.0)
    shown = WithoutScene(gaussians, str(out), 7, circle_cameras(places))
    page = Page(ANY, shown, pipeline(), False, False, oriented=str(scene))
    tab = page.measure
    with Client(page.url) as client:
        client.look()
        wait_for(page.server.get_clients)

        def click(tool: str, rows: tuple[int, ...]) -> None:
            tab.tool.value = tool
            wait_for(lambda: page.server.scene._scene_pointer_cb)
            for number, row in enumerate(rows, 1):
                ray = places[row] - [0, 0, -4]
                sent = {"ray_origin": (0.0, 0.0, -4.0), "ray_direction": (ray / np.linalg.norm(ray)).tolist()}
                client.send("ScenePointerMessage", event_type="click", screen_pos=((0.5, 0.5),), modifier=None, **sent)
                wait_for(lambda: page.requests.any)
                answer(page)
                assert len(tab.points[tool]) == number

        def press(button: object, done: Callable[[], bool], title: str) -> None:
            _set(client, button, True)
            wait_for(done)
            assert client.until("NotificationShowMessage")["props"]["title"] == title

        click("A length", (0, 1))
        assert tab.length == pytest.approx(2, abs=1e-2) and "units of the scene" in tab.says.content
        assert tab.keep.disabled
        with pytest.raises(UserError, match="nothing to set right"):
            tab.write()
        page.frames.surface = None
        page._find_point(None, places[0], lambda point: tab.add("A length", point))  # as on a full GPU
        answer(page)
        assert "There is no surface" in tab.says.content and client.until("NotificationShowMessage")["props"]["title"]
        del page.frames.surface
        tab.points["A length"] = [places[0], places[1]]
        tab.metres.value = 5.0
        wait_for(lambda: not tab.keep.disabled)
        click("The ground", (0, 1, 2))
        assert "tilted by 0." in tab.says.content
        click("The front", (2, 1))
        press(tab.keep, lambda: (scene / "orientation.json").is_file() and "5 m" in tab.says.content, "Set right")
        record = read_orientation(scene)
        for point in ([0, 0, 0], [1, 0.2, 0], [0.0, 0.0, 1.0]):
            tab.add("The ground", np.array(point))
        assert "tilted by 11.3 degrees in the photos" in tab.says.content
        tab.write()
        assert read_orientation(scene) != record
        press(tab.back, lambda: read_orientation(scene) == record, "As before")
    page.stop()
    assert recorded_similarity(str(out), "")["similarity"] == record
    found = Similarity.read(record, "here").from_local(np.array([10.0, 0, 0]))
    assert found.metric and found.scale == pytest.approx(2.5, rel=1e-2)
    moved = found.transform(places)
    np.testing.assert_allclose(moved[:3, 1], 0, atol=0.03)
    assert moved[3, 1] == pytest.approx(-2.5, abs=0.05)  # above
    assert moved[1, 0] > moved[2, 0] and moved[1, 2] == pytest.approx(moved[2, 2], abs=0.03)  # the front is along x


def test_what_is_measured_spares_another_orientation_of_the_scene(tmp_path):
    model, scene = tmp_path / "model.json", tmp_path / "orientation.json"
    record = {"rotation": np.eye(3).tolist(), "scale": 2.0, "translation": [0, 0, 0]}
    record |= {"unit": "metre", "vertical": "GPS"}
    first = {"similarity": record | {"scale": 3}}
    model.write_text(json.dumps(first)), scene.write_text(json.dumps(record))
    place = Place(tmp_path, str(tmp_path), (0.0, 0.0, 0.0))
    for scale in (5, 4):
        assert place.write(record | {"scale": scale}) == [model]
        assert json.loads(model.read_text())["similarity"]["scale"] == scale
    for scale in (5, 3):
        assert place.restore() == [model] and place.record["scale"] == scale
    assert json.loads(model.read_text()) == first and json.loads(scene.read_text()) == record
    model.write_text("{}"), scene.unlink()
    place = Place(tmp_path, str(tmp_path), (0.0, 0.0, 0.0))
    place.write(record)
    model.write_text(json.dumps({"similarity": record, "antialiasing": True}))  # by a training
    place.restore()
    assert not scene.exists() and place.record is None and json.loads(model.read_text()) == {"antialiasing": True}
