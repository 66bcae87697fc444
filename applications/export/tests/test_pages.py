"""One-file HTML of a model: what is in the file, where its cameras stand, and what is vendored."""

import gzip
import hashlib
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from gaussians import pipeline
from html_page import Page
from html_scene import CENTRE, FOV, SIZE, UP, balls, cameras
from PIL import Image

import export
from applications.export import html, vendor
from applications.export.formats import SceneInputs, find_format
from applications.export.html import find_up, make_settings, turn_upright, write_html
from applications.export.notes import Note, Notes, read_notes
from applications.export.page_start import PICTURE, check_note, find_named, write_preview
from gaussian_renderer import render
from gaussian_renderer.camera_paths import without_scene
from gaussian_renderer.camera_paths.generated import Ellipse
from gaussian_renderer.camera_paths.keyframes import CameraPath, Keyframe, KeyframePath
from gaussian_renderer.camera_paths.poses import Poses, poses_of
from gaussian_renderer.camera_paths.start import LEAST, MOST, best_start, narrow_fov
from gaussian_renderer.free_view import free_view
from scene.splats.ply import read_compressed_ply
from scene.with_splats import model_of
from splatting import cleaning
from utils.system_utils import UserError


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


@pytest.mark.parametrize(("views", "said"), [
    (cameras(), "a page of 600 Gaussians of SH degree 1 would have .* --max_splats or --sh_deg"),
    ([], "a page needs at least one training camera"),
])  # fmt: skip
def test_a_page_that_nobody_could_use_is_not_written(tmp_path, monkeypatch, views, said):
    monkeypatch.setattr(html, "LONGEST", 1000)
    with pytest.raises(UserError, match=said):
        write_html(tmp_path / "page.html", balls(), views)
    assert not list(tmp_path.iterdir())


CONTENT = """# Two balls
Author: A. Name
GPS:48.1, 11.6
Author: B. Name
They float.

Time: it is late.

## The red one
camera: photo_3
Redder: <b>than</b> you think.

## The blue one
Camera:photo_5.jpg
"""


@pytest.fixture
def written(tmp_path):
    path = tmp_path / "notes.md"
    path.write_text("\ufeff" + CONTENT, encoding="utf-8")
    return path


def test_a_file_of_notes_has_a_title_facts_text_and_views(written):
    facts = ("Author", "A. Name"), ("GPS", "48.1, 11.6"), ("Author", "B. Name")
    views = Note("The red one", "Redder: <b>than</b> you think.", "photo_3"), Note("The blue one", "", "photo_5.jpg")
    assert read_notes(str(written)) == Notes("Two balls", facts, "They float.\n\nTime: it is late.", views)


@pytest.mark.parametrize("line", ["at: 812 344", "At:812, 344.0", "at: 812 x 344"])
def test_a_view_may_say_where_in_its_photo_a_thing_is(tmp_path, line):
    path = tmp_path / "notes.md"
    path.write_text(f"## Here\ncamera: a.jpg\n{line}\nA leaf.\n\n## There\ncamera: b.jpg\nAt: noon")
    here, there = read_notes(str(path)).views
    assert here == Note("Here", "A leaf.", "a.jpg", (812.0, 344.0)) and there == Note("There", "At: noon", "b.jpg")


def test_a_note_stands_on_what_its_photo_shows_at_its_place(tmp_path):
    ring, place = cameras(), (410.0, 230.0)
    for camera in ring:
        camera.photo_size = 800, 600  # trains at half of it
    notes = Notes(views=(Note("Red", "", "photo_3", place), Note("Sky", "", "photo_4", (5.0, 5.0))))
    write_html(tmp_path / "page.html", balls(), ring, upright=True, notes=notes)
    marks = json.loads(Page(tmp_path / "page.html").texts["page"])["settings"]["annotations"]
    for mark, camera, at in zip(marks, ring[3:5], (place, (5.0, 5.0)), strict=True):
        point = np.array([-1.0, -1.0, 1.0]) * mark["position"]
        clip = np.append(point, 1) @ camera.full_proj_transform.double().numpy()
        assert (clip[:2] / clip[3] + 1) / 2 * camera.photo_size == pytest.approx(at, abs=0.5)
        if at == place:
            assert np.linalg.norm(point - CENTRE - 0.5 * UP) < 0.6
    check_note(notes.views[0], ring)
    with pytest.raises(UserError, match="“Red” is at 810 230, outside of photo_3 with 800 x 600 pixels; count pixels"):
        check_note(notes.views[0]._replace(at=(810.0, 230.0)), ring)


@pytest.mark.parametrize(("content", "said"), [
    (b"## Here\nText", "“Here” has no camera; write a name after ##, and camera: PHOTO below"),
    (b"## \ncamera: a.jpg", "“” has no camera; write a name after ##"),
    (b"# One\n# Two", "“# Two” is not the first line; begin views with ##"),
    (b"Text\n# One", "“# One” is not the first line; begin views with ##"),
    (b"## Here\ncamera: a.jpg\n" + 1001 * b"x", "“Here” has 1,001 letters; shorten it to 1,000"),
    (26 * b"## Here\ncamera: a.jpg\n", "has 26 views, and a page takes 25; remove some"),
    (b"## Here\ncamera: a.jpg\nat: 812", "“Here” is at: 812; give two numbers of pixels, such as at: 812 344"),
    (b"## Here\ncamera: a.jpg\nat: 1.2.3 4", "give two numbers of pixels"),
    (b"\xff\xfe", "cannot be read as UTF-8 text"),
    (None, "cannot be read as UTF-8 text"),
])  # fmt: skip
def test_notes_that_cannot_be_used_say_why(tmp_path, content, said):
    path = tmp_path / "notes.md"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UserError, match=said):
        read_notes(str(path))


def test_a_page_shows_its_notes(written, tmp_path):
    path = tmp_path / "page.html"
    write_html(path, balls(), cameras(), notes=read_notes(str(written)))
    page = Page(path)
    marks = json.loads(page.texts["page"])["settings"]["annotations"]
    texts = {mark["title"]: mark["text"] for mark in marks}
    assert texts == {"The red one": "Redder: <b>than</b> you think.", "The blue one": ""}
    for mark in marks:  # stands at the balls, which are 0.45 thick and 3.7 away
        assert 2.7 < np.linalg.norm(np.subtract(mark["position"], mark["camera"]["initial"]["position"])) < 4
    assert page.texts["title"] == "Two balls" and "<p>Author: A. Name</p>" in path.read_text(encoding="utf-8")
    write_html(path, balls(), cameras(), title="Mine", notes=read_notes(str(written)))
    assert Page(path).texts["title"] == "Mine"
    written.write_text("## Here\ncamera: nowhere", encoding="utf-8")
    with pytest.raises(UserError, match="--notes: nowhere is no training photo; there are photo_0.jpg"):
        write_html(path, balls(), cameras(), notes=read_notes(str(written)))


def _meta(page: Path) -> dict[str, str]:
    return {
        attributes.get("property") or attributes.get("name"): attributes.get("content")
        for tag, attributes in Page(page).tags
        if tag == "meta"
    }


def test_a_page_begins_at_a_usual_camera_that_looks_at_the_middle():
    poses = poses_of(cameras(8))
    assert best_start(poses) == 0  # all are alike
    turns, places = poses.turns.copy(), poses.positions.copy()
    turns[:3] = turns[:3] @ np.array([[[0.9, 0, 0.435889894], [0, 1, 0], [-0.435889894, 0, 0.9]]])  # look aside
    middle = places.mean(0)
    places[3] = middle + 3 * (places[3] - middle)
    assert best_start(Poses(places, turns, poses.fov)) >= 4
    assert best_start(poses[np.array([0])]) == 0  # looks at nothing in common


def test_a_start_is_named_with_or_without_its_ending():
    names = [f"photo_{n}.jpg" for n in range(8)]
    assert find_named("photo_3.jpg", names, "") == find_named("photo_3", names, "") == 3
    with pytest.raises(UserError, match=r"--start photo is no training photo; there are photo_0.jpg, .* and 3 more"):
        find_named("photo", names, "--start photo")


@pytest.mark.parametrize(("photo", "window", "heights"), [
    (1.5, 1.5, 1),
    (1.5, 1.6, 1.5 / 1.6),  # fills the width
    (0.5, 2.0, LEAST),
    (1.5, 1.3, 1),  # fills the height
    (1.5, 0.75, LEAST * 2),
    (1.5, 390 / 844, MOST),  # a phone
    (0.75, 390 / 844, LEAST * 0.75 * 844 / 390),
    (0.4, 0.5, LEAST),
])  # fmt: skip
def test_a_photo_fills_a_window_unless_that_hides_much_of_it(photo, window, heights):
    assert math.tan(narrow_fov(math.radians(40), photo, window) / 2) == pytest.approx(
        heights * math.tan(math.radians(20))
    )


def test_the_picture_beside_a_link_is_the_first_one(tmp_path):
    splats, camera = balls(), cameras(rolls=())[2]
    write_preview(tmp_path / "page.jpg", splats, camera, pipeline(), (0.2, 0.4, 0.3))
    shown = np.asarray(Image.open(tmp_path / "page.jpg"), np.float64)
    assert shown.shape == (*PICTURE[::-1], 3)
    poses, fov = poses_of([camera]), narrow_fov(math.radians(FOV), SIZE[0] / SIZE[1], PICTURE[0] / PICTURE[1])
    view = free_view(*PICTURE, fov, poses.positions[0].tolist(), poses.quaternions[0].tolist(), "cpu")
    with torch.no_grad():
        image = render(view, model_of(splats), pipeline(), torch.tensor([0.2, 0.4, 0.3]))["render"]
    assert np.abs(shown - 255 * image.clamp(0, 1).permute(1, 2, 0).numpy()).mean() < 2


@pytest.mark.parametrize("name", ["</script><script>alert(1)</script>", "<!--<script>", "a & b ' \" ü", "caf\udce9"])
def test_names_and_titles_are_text_whatever_they_hold(tmp_path, name):
    views, path = cameras(), tmp_path / "my page #1.html"  # a photo "my page #1.jpg" beside it would stay
    for camera in views:
        camera.image_name = name
    around = SceneInputs(views, (0.0, 0.0, 0.0), pipeline(), None, None, name, name)
    find_format(path).write(path, balls(each=9), around)
    meta, shown = _meta(path), name.encode("utf-8", "backslashreplace").decode()
    assert meta["og:type"] == "website" and meta["og:image"] == "my%20page%20%231.html.jpg"
    assert sorted(file.name for file in tmp_path.iterdir()) == ["my page #1.html", "my page #1.html.jpg"]
    notes = Notes(facts=(("author", name),), text=name, views=(Note(name, name, name),))
    write_html(path, balls(each=9), views, title=name, notes=notes)
    page = Page(path)
    mark = json.loads(page.texts["page"])["settings"]["annotations"][0]
    assert page.texts["title"] == page.texts["span"] == meta["og:title"] == shown
    assert mark["title"] == mark["text"] == name and [tag for tag, _ in page.tags].count("script") == 4


def test_pages_are_cleaned_unless_they_are_raw(early, tmp_path, monkeypatch, run_export, capsys):
    asked = []

    def clean_scene(scene, most, pipe, white):
        asked.append(most)
        raise UserError("enough is known")

    monkeypatch.setattr(export, "clean_scene", clean_scene)
    words = "-m", early, "--to", tmp_path / "page.html"
    for picture in ("page.html.jpg", "page.html.removed.png"):
        (tmp_path / picture).write_bytes(b"mine")
        with pytest.raises(UserError, match=f"no export wrote .*{picture} as it is, .* replace it; move"):
            run_export(*words)
        assert (tmp_path / picture).read_bytes() == b"mine" and not asked
        (tmp_path / picture).unlink()
    for more, most in (((), cleaning.OPTION["const"]), (("--clean", 0.2), 0.2)):
        with pytest.raises(UserError, match="enough is known"):
            run_export(*words, *more)
        assert asked.pop() == most
    capsys.readouterr()
    run_export(*words, "--raw", "--title", "Room")
    assert "warning" not in capsys.readouterr().err
    assert not asked and (tmp_path / "page.html.jpg").is_file() and _meta(tmp_path / "page.html")["og:title"] == "Room"
    monkeypatch.setattr(without_scene, "have_moved", lambda *_: True)
    run_export(*words, "--raw")
    assert "warning: the scene's poses are not those that" in capsys.readouterr().err
