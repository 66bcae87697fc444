"""One-file HTML of a model: what is in the file, where its cameras stand, and what is vendored."""

import gzip
import hashlib
import json
import math
import re
import zlib

import numpy as np
import pytest
from html_page import Page
from html_scene import CENTRE, FOV, UP, balls, cameras

from applications.export import html, vendor
from applications.export.html import find_up, make_settings, turn_upright, write_html
from applications.export.notes import Note, Notes
from gaussian_renderer.camera_paths.generated import Ellipse
from gaussian_renderer.camera_paths.keyframes import CameraPath, Keyframe, KeyframePath
from gaussian_renderer.camera_paths.poses import poses_of
from scene.splats.ply import read_compressed_ply
from utils.system_utils import UserError

# Addresses in the viewer's code. It asks for none of them here: those of PlayCanvas and Khronos are in texts, SVG is a
# name, and jsDelivr would have models of the hand-held controllers of a VR headset, which the page's policy refuses.
ADDRESSES = {
    "http://www.w3.org/2000/svg",
    "https://cdn.jsdelivr.net/npm/@webxr-input-profiles/assets/dist/profiles",
    "https://github.com/playcanvas/engine",
    "https://github.com/playcanvas/supersplat-viewer",
}


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Page:
    path = tmp_path_factory.mktemp("page") / "balls.html"
    write_html(path, balls(), cameras(), background=(1.0, 0.5, 0.0))
    return Page(path)


def test_vendored_files_are_those_of_the_record():
    record = json.loads(vendor.RECORD.read_text())
    files = {path.name: path.read_bytes() for path in vendor.FOLDER.iterdir() if path != vendor.RECORD}
    files[vendor.UNPACKED] = gzip.decompress(files.pop(vendor.VIEWER))
    assert {name: hashlib.sha256(content).hexdigest() for name, content in files.items()} == record["sha256"]
    assert record["license"] == "MIT" and (vendor.FOLDER / "LICENSE").read_text().startswith("MIT License")
    for name in ("viewer.js", "viewer.css"):
        assert f"{record['package']} {record['version']}, MIT" in files[name][:100].decode()


def test_the_viewer_names_no_other_addresses():
    code = gzip.decompress((vendor.FOLDER / vendor.VIEWER).read_bytes()).decode()
    code += (vendor.FOLDER / "viewer.css").read_text()
    assert set(re.findall(r"""(?:https?|wss?)://[^"'`\s<>)\\]+""", code)) == ADDRESSES
    assert "@import" not in code and "new Function" not in code


def test_the_page_refers_to_nothing_outside(page):
    for tag, attributes in page.tags:
        for name in ("src", "href", "action", "data", "poster", "srcset"):
            assert attributes.get(name, "data:").startswith("data:"), (tag, attributes)
    for name, text in page.texts.items():
        without_comments = re.sub(r"(^|\s)// .*$", "", text, flags=re.MULTILINE)
        assert "//" not in without_comments or name in ("model", "viewer"), name
    assert page.unpacked("viewer") == gzip.decompress((vendor.FOLDER / vendor.VIEWER).read_bytes())
    policy = next(a["content"] for _, a in page.tags if a.get("http-equiv") == "Content-Security-Policy")
    allowed = {words.split()[0]: words.split()[1:] for words in policy.split(";")}
    assert allowed["default-src"] == ["'none'"]
    assert {source for sources in allowed.values() for source in sources} == {
        "'none'", "'unsafe-inline'", "blob:", "data:",
    }  # fmt: skip


@pytest.mark.parametrize("name", ["</script><script>alert(1)</script>", "<!--<script>", "a & b ' \" ü", "caf\udce9"])
def test_names_stay_names(tmp_path, name):
    views = cameras()
    for camera in views:
        camera.image_name = name
    notes = Notes(facts=(("author", name),), text=name, views=(Note(name, name, name),))
    write_html(tmp_path / "page.html", balls(each=2), views, title=name, notes=notes)
    page = Page(tmp_path / "page.html")
    assert [tag for tag, _ in page.tags].count("script") == 4
    shown = name.encode("utf-8", "backslashreplace").decode()
    content = json.loads(page.texts["page"])
    mark = content["settings"]["annotations"][0]
    assert page.texts["title"] == page.texts["span"] == shown and mark["title"] == mark["text"] == name


def test_a_page_has_the_name_of_its_file_its_background_and_the_viewers_licence(page):
    content = json.loads(page.texts["page"])
    assert page.texts["title"] == "balls" and "rgb(255, 128, 0)" in page.texts["style"]
    assert content["settings"]["background"]["color"] == [1.0, 0.5, 0.0] and content["antialiasing"] is False
    assert (vendor.FOLDER / "LICENSE").read_text() in page.comments


def test_the_model_in_the_page_is_upright(page, tmp_path):
    content = json.loads(page.texts["page"])
    (tmp_path / content["name"]).write_bytes(page.unpacked("model"))
    splats = read_compressed_ply(tmp_path / content["name"])
    red = splats.sh[:, 0, 0] > splats.sh[:, 0, 2]
    assert len(splats) == 600 and red.sum() == 300
    apart = splats.means[red].mean(axis=0) - splats.means[~red].mean(axis=0)
    assert apart / np.linalg.norm(apart) == pytest.approx([0, -1, 0], abs=0.05)  # up, in COLMAP's axes


def test_up_is_where_the_horizons_are_level():
    ring = poses_of(cameras(rolls=()))
    assert find_up(ring) == pytest.approx(UP, abs=1e-6)
    side = ring[np.arange(3)]  # all look down from one side, so that their mean up leans to it
    assert math.degrees(math.acos(side.up @ UP / np.linalg.norm(side.up))) > 8
    assert find_up(side) == pytest.approx(UP, abs=1e-2)
    one = ring[np.zeros(4, int)]
    assert find_up(one) == pytest.approx(one.up, abs=1e-6)


def test_the_first_camera_is_where_the_page_begins(page):
    content = json.loads(page.texts["page"])["settings"]
    first = content["cameras"][0]["initial"]
    pose = poses_of(cameras())
    axes = np.diag([-1.0, -1.0, 1.0]) @ turn_upright(find_up(pose))
    assert first["position"] == pytest.approx(axes @ pose.positions[0], abs=1e-6)
    assert first["target"] == pytest.approx(axes @ CENTRE, abs=1e-4) and first["fov"] == pytest.approx(FOV, abs=1e-4)
    marks = content["annotations"]
    assert [mark["title"] for mark in marks] == [f"View {n} of 8" for n in range(1, 9)]
    assert marks[0]["camera"]["initial"] == first
    leans = [mark["extras"]["lean"] for mark in marks]
    assert leans[0] == pytest.approx(-12, abs=4) and np.abs(leans[1:]).max() < 3  # that camera also moves `find_up`


def test_the_animation_follows_the_camera_path():
    poses = poses_of(cameras())

    def track(path) -> dict:
        content = make_settings(poses, [""] * len(poses), np.eye(3), path, (0, 0, 0))
        assert content["startMode"] == "animTrack"
        return content["animTracks"][0]

    keys = [Keyframe(s, (s, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 40 + s) for s in (0.0, 2.0, 4.0)]
    open_track, closed = track(KeyframePath(CameraPath(tuple(keys)))), track(Ellipse(poses, 600.0))
    assert (open_track["loopMode"], open_track["duration"], open_track["frameRate"]) == ("none", 4, 10)
    assert open_track["keyframes"]["times"] == list(range(41))
    values = open_track["keyframes"]["values"]
    position, target = (np.reshape(values[name], (-1, 3)) for name in ("position", "target"))
    assert position[20] == pytest.approx([-2, 0, 0]) and values["fov"][30] == pytest.approx(43)
    assert ((target - position)[:, 2] > 1).all() and np.abs((target - position)[:, :2]).max() < 1e-9
    times = closed["keyframes"]["times"]
    assert (closed["loopMode"], len(times), closed["duration"]) == ("repeat", 999, 600)
    assert (times[-1] + 1) / closed["frameRate"] == pytest.approx(600)


@pytest.mark.parametrize(
    ("views", "said"),
    [
        (cameras(), "a page of 600 Gaussians of SH degree 1 would have .* --max_splats or --sh_deg"),
        ([], "a page needs at least one training camera"),
    ],
)
def test_a_page_that_nobody_could_use_is_not_written(tmp_path, monkeypatch, views, said):
    monkeypatch.setattr(html, "LONGEST", 1000)
    with pytest.raises(UserError, match=said):
        write_html(tmp_path / "page.html", balls(), views)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("count", [1, 1 << 20, (1 << 21) + 5])
def test_pages_are_packed_in_pieces_of_one_member(count):
    content = np.random.default_rng(count).integers(0, 9, count, np.uint8).tobytes()
    packed = html._gzip(memoryview(content))
    unpacker = zlib.decompressobj(31)
    assert unpacker.decompress(packed) == content and unpacker.eof and not unpacker.unused_data
    assert len(packed) < 1.01 * len(gzip.compress(content)) + 100
