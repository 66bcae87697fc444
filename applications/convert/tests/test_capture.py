"""The report of a capture: what it finds and advises, its page, and what train.py says of it."""

import argparse
import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image, ImageFilter
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

import train
from applications.convert import report
from applications.convert.capture_page import write_page
from applications.convert.checks import (
    check_reconstruction,
    describe_capture,
    find_gaps,
    find_neighbours,
    is_folded,
    is_only_turned,
    is_wrong,
    rate_capture,
    why_unusable,
)
from applications.convert.layout import Layout
from applications.convert.photo_quality import compare_brightness, measure_looks
from scene.checks.conversion import describe_left_out
from scene.checks.photos import SHARED_TEXT
from scene.rotation_only import rotation_error
from scene.unmatched import find_cover, find_overlaps
from splatting.checks import check_native
from utils.system_utils import UserError

NAMES = ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]


def _report(placed: int, photos: int, *left: str) -> dict:
    counted = {"registered": placed, "photos": photos, "points": 90, "mean_track_length": 3.0, "mean_error_px": 0.5}
    return {**counted, "left_out": {name: {"partners": 0} for name in left}, "advice": []}


def _survey() -> dict:
    """Photos a, b and c see much of each other; d shares little with a alone."""
    near = {name: {other: 80 for other in NAMES[:3] if other != name} for name in NAMES[:3]}
    shared = near | {"d.jpg": {"a.jpg": 12}}
    place = {name: {"place": [i, 0, 0], "view": [0, 0, 1], "up": [0, -1, 0]} for i, name in enumerate(NAMES)}
    photos = {name: place[name] | {"points": 90, "shared": shared[name]} for name in NAMES}
    return {"photos": photos, "points": [[0, 0, 5], [1, 0, 6]], "colors": [[255, 0, 0], [0, 0, 255]]}


@pytest.fixture
def folder(tmp_path):
    """Four photos of noise: b is out of focus, and d two stops darker."""
    noise = np.random.default_rng(0).uniform(40, 200, (60, 80, 3)).astype(np.uint8)
    for name in NAMES:
        image = Image.fromarray(noise)
        image = image.filter(ImageFilter.GaussianBlur(3)) if name == "b.jpg" else image
        image = image.point(lambda value: value * 0.25 ** (1 / 2.2)) if name == "d.jpg" else image
        image.save(tmp_path / name, quality=95)
    return tmp_path


def test_what_is_weak_blurred_and_darker_is_named(folder):
    looks = measure_looks(folder, NAMES)
    assert looks["a.jpg"].brightness - looks["d.jpg"].brightness == pytest.approx(2.0, abs=0.1)
    assert find_neighbours(_survey()["photos"])["d.jpg"] == []
    captioned = _report(4, 5, "e.jpg") | {"advice": [f"9% of each photo, at the top, {SHARED_TEXT}; mask it"]}
    assert not any("e.jpg" in line for line in rate_capture(captioned, _survey()["photos"], looks)["again"])
    found = rate_capture(_report(4, 5, "e.jpg"), _survey()["photos"], looks)
    assert (found["weakly_connected"], found["blurred"]) == (["d.jpg"], ["b.jpg"])
    assert found["brightness_spread_stops"] == pytest.approx(np.std([0, 0, 0, 2]), abs=0.05)
    starts = "Take photos on the way from e.jpg to the others, each over", "Take more photos around d.jpg", "Hold the"
    assert [line[: len(start)] for line, start in zip(found["again"][:3], starts, strict=True)] == [*starts]
    assert found["again"][-1].endswith("--appearance ppisp")
    weak, blur, *_ = describe_capture(_report(4, 5, "e.jpg") | found)
    assert weak == "overlap: 1 of 4 photos weakly connected (d.jpg)" and blur == "blur: 1 of 5 photos blurred (b.jpg)"


def test_where_photos_are_missing_is_said():
    """The placed photos around a hole name it; single photos, and those at an end of a folder, are none."""
    placed = ["0.jpg", "3.jpg", "5.jpg", "9.jpg", "a/1.jpg", "a/5.jpg"]
    left = ["1.jpg", "2.jpg", "4.jpg", "6.jpg", "7.jpg", "8.jpg", "a/0.jpg", "a/6.jpg", "b/1.jpg", "b/2.jpg"]
    assert find_gaps(left, placed) == [(3, "5.jpg", "9.jpg"), (2, "0.jpg", "3.jpg")]
    photos = {name: {"shared": {other: 99 for other in placed if other != name}} for name in placed}
    report = _report(6, 16, *left) | {"tried": [{"against": ["1.jpg", "4.jpg"]}]}
    said = rate_capture(report, photos, {})["again"]
    assert len(said) == 3 and said[0] == "Take photos between 5.jpg and 9.jpg: 3 there could not be placed"
    assert said[2].startswith("Take photos on the way from a/0.jpg, a/6.jpg, b/1.jpg, b/2.jpg to")
    assert not find_gaps(["1.jpg"], ["0.jpg", "2.jpg"]) and not find_gaps([], placed) and not find_gaps(left, [])


def test_what_photos_show_does_not_count(tmp_path):
    """A camera of one exposure passes from what is bright and rich to what is dark and plain. b is blurred, e lit."""
    rng, layout, width = np.random.default_rng(0), Layout(tmp_path), 1000
    shade = np.linspace(1, 0.2, width)[None, :, None]
    texture = sum(s * gaussian_filter(rng.normal(size=(120, width, 3)), (s, s, 0)) for s in (0.6, 2, 4, 8))
    wall = texture * 60 * shade**2 + 150 * shade
    names = [f"{letter}.jpg" for letter in "abcdefgh"]
    places = np.column_stack([rng.uniform(2, width - 2, 2000), rng.uniform(2, 118, 2000)])
    lines = []
    (layout.sparse / "0").mkdir(parents=True)
    layout.images.mkdir()
    for number, name in enumerate(names):
        view = wall[:, 100 * number :][:, :300]
        view = gaussian_filter(view, (4, 4, 0)) if name == "b.jpg" else view
        view = view * 4 ** (1 / 2.2) if name == "e.jpg" else view
        Image.fromarray(view.clip(0, 255).astype(np.uint8)).save(layout.images / name, quality=97)
        seen = places - (100 * number, 0)
        ids = np.flatnonzero((seen[:, 0] > 0) & (seen[:, 0] < 300))
        lines += [f"{number + 1} 1 0 0 0 0 0 0 1 {name}", " ".join(f"{seen[i, 0]} {seen[i, 1]} {i}" for i in ids)]
    (layout.sparse / "0" / "cameras.txt").write_text("1 PINHOLE 300 120 300 300 150 60\n")
    (layout.sparse / "0" / "images.txt").write_text("\n".join(lines) + "\n")
    (layout.sparse / "0" / "points3D.txt").write_text("")
    photos = {name: {"shared": {other: 99 for other in names if other != name}} for name in names}
    alone = rate_capture(_report(8, 8), photos, measure_looks(layout.images, names))
    found = rate_capture(_report(8, 8), photos, compare_brightness(measure_looks(layout.images, names), layout))
    assert alone["brightness_spread_stops"] > 1
    assert alone["blurred"] == found["blurred"] == ["b.jpg"]
    assert found["brightness_spread_stops"] == pytest.approx(np.std([0] * 7 + [2]), abs=0.15)
    (layout.sparse / "0" / "images.txt").write_text("\n\n".join(lines[::2]) + "\n\n")
    found = rate_capture(_report(8, 8), photos, compare_brightness(measure_looks(layout.images, names), layout))
    assert found["brightness_spread_stops"] is None and found["blurred"] == ["b.jpg"]
    assert len(describe_capture(_report(8, 8) | found)) == 3


def _page(folder, names, survey, **report) -> str:
    looks = measure_looks(folder, NAMES)
    report = _report(len(survey["photos"]), len(names), *sorted(set(names) - set(survey["photos"]))) | report
    report |= rate_capture(report, survey["photos"], looks)
    write_page(folder / "capture.html", report, survey, looks, names, folder)
    return (folder / "capture.html").read_text(encoding="utf-8")


def test_the_page_shows_what_is_wrong_with_each_photo(folder):
    """Photos e and f have no files."""
    text = _page(folder, [*NAMES, "e<&.jpg", "f.jpg"], _survey(), tried=[{"way": "global", "against": ["f.jpg"]}])
    cards = re.findall(r'<div id="photo\d+".*?<b>(.*?)</b>\n(.*?)</div>', text, re.S)
    problems = {name: "".join(re.findall('"problem">(.*?)<', card)) for name, card in cards}
    assert problems == {"b.jpg": "blurred", "d.jpg": "weakly connected", "e&lt;&amp;.jpg": "not placed"} | {
        "f.jpg": "left out: too few other photos match it", "a.jpg": "", "c.jpg": "",
    }  # fmt: skip
    assert "<dt>neighbours</dt><dd>2</dd>" in cards[0][1] and "<dt>matching photos</dt><dd>0</dd>" in cards[2][1]
    assert [re.findall("brightness</dt><dd>(.*?)<", card) for _, card in cards[1:5]] == [["-2.0"], [], [], ["+0.0"]]
    assert text.count("data:image/jpeg;base64,") == len(NAMES) and "e<&" not in text
    drawn = re.findall('<a href="#photo(.)"( class="weak")?.*?<title>(.*?)</title>', text)
    assert [f"{number}{name}" for number, _, name in drawn] == ["5c.jpg", "4a.jpg", "1d.jpg", "0b.jpg"] and drawn[2][1]
    assert '<li class="problem">4 of 6 photos placed' in text and "<li>Take more photos around d.jpg" in text


def test_a_training_says_what_its_scene_lacks(tmp_path):
    assert describe_left_out(tmp_path) is None and why_unusable(_report(6, 10)) is None
    assert "only 5 of 10 photos" in why_unusable(_report(5, 10))
    for content, said in (
        (json.dumps(_report(14, 30)), "this scene has 14 of 30 photos (47%) of its capture"),
        (json.dumps(_report(30, 30)), ""),
        ("[]", ""),
    ):
        (tmp_path / "convert_report.json").write_text(content)
        assert (describe_left_out(tmp_path) or "").startswith(said) and bool(describe_left_out(tmp_path)) == bool(said)


def test_a_training_says_that_native_lenses_come_too_late(colmap_scene, tmp_path, capsys):
    text = "warning: --lenses native has no effect, since convert.py undistorted the photos of this scene; to train on"
    words = ["-s", str(colmap_scene), "-m", str(tmp_path / "out"), "-r", "24", "--iterations", "1", "--quiet"]
    for given, kept in (("native", "native"), ("auto", "undistort"), ("native", "undistort")):
        (colmap_scene / "convert_report.json").write_text(json.dumps(_report(17, 17) | {"lenses": kept}))
        check_native(argparse.Namespace(source_path=str(colmap_scene), lenses=given))
        assert (text in capsys.readouterr().err) == (given != kept and given == "native")
    train.main([*words, "--lenses", given, "--no_curve", "--test_iterations", "-1"])
    assert text in capsys.readouterr().err


def test_photos_of_a_model_stay_in_their_folder(tmp_path):
    layout = Layout(tmp_path)
    layout.work.mkdir()
    for name in ("../a.png", "/a.png", "deep/../../a.png"):
        layout.survey.write_text(json.dumps([report.Model("0", [name], 1, 1.0, 1.0, [])._asdict()]))
        with pytest.raises(UserError, match="names a photo .*a.png, outside of the folder of its photos"):
            report.read_survey(layout, [])


def _model(registered: int, points: int = 5000, track: float = 5.0, error: float = 0.5, first: int = 0) -> report.Model:
    return report.Model("0", [f"{i:03d}" for i in range(first, first + registered)], points, track, error, [])


PHOTOS = [f"{i:03d}" for i in range(40)]


def test_poses_that_no_pair_judged_are_not_called_right():
    words, judged = ([_model(40)], PHOTOS, dict.fromkeys(PHOTOS, 3), "auto", 0), {"way": "global", "photos": 40}
    (line,) = map(str, check_reconstruction(*words, tried=[judged | {"pairs": 0}]))
    assert line.startswith("the poses could not be judged")
    judged |= {"pairs": 90, "agreeing": 40, "contradicting": 0.02}
    assert [*check_reconstruction(*words, tried=[judged])] == []


@pytest.mark.parametrize(("models", "said"), [
    ([_model(40)], []),
    ([_model(38)], [r"2 of 40 photos left out \(038, 039\), 1 of them without a match .*else; --matcher"]),
    ([_model(25), _model(15, first=25)], ["15 of 40", r"form 2 unconnected parts \(25 photos are used, the oth"]),
    ([_model(40), _model(12)], []),
    ([_model(40, points=900)], ["only 900 points; .*1000; use larger .* photos, or --max_num_features 16384$"]),
    ([_model(40, track=2.4)], ["in 2.4 photos on average, so the photos overlap little"]),
    ([_model(40, error=2.0)], ["mean reprojection error is 2.0 pixels"]),
])  # fmt: skip
def test_advice(models, said):
    lines = [*map(str, check_reconstruction(models, PHOTOS, dict.fromkeys(PHOTOS[:39], 3), "sequential", 8192))]
    assert [bool(re.search(expected, line)) for line, expected in zip(lines, said, strict=True)] == [True] * len(said)


def test_per_photo_is_not_advised_to_who_has_it():
    wrong = {"way": "global", "photos": 40, "pairs": 90, "agreeing": 9, "contradicting": 0.9, "against": PHOTOS[:2]}
    words = [_model(25, error=9.0), _model(15, first=25)], PHOTOS, dict.fromkeys(PHOTOS, 9), "auto", 0, [wrong], 0
    for mode, count in (("per_lens", 4), ("per_photo", 0)):
        assert sum("per_photo" in line for line in map(str, check_reconstruction(*words, mode))) == count


WIDTH, HEIGHT, FOCAL = 400, 300, 240.0
HALF = np.array([2.5, 1.25, 2.0])  # of a room, in units
JUDGED = {"pairs": 90, "contradicting": 0.0, "agreeing": 20, "photos": 20, "bound": 20}


def _walls(count: int, seed: int) -> np.ndarray:
    """Points (count, 3) on the walls of a room around the origin."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3))
    axis = rng.integers(0, 3, count)
    points[np.arange(count), axis] = np.sign(points[np.arange(count), axis])
    return points * HALF


def _wall(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (count, 3)) * [6, 1.5, 0.0] + [0, 0, 2]


Pose = tuple[np.ndarray, np.ndarray]  # a camera's place (3,) and its turn from the world (3, 3)


def _turning(noise: float) -> list[Pose]:
    rng = np.random.default_rng(0)
    return [(noise * rng.standard_normal(3), _turn("yx", [20 * k, rng.uniform(-5, 5)])) for k in range(18)]


def _turn(axes: str, degrees: float | list[float]) -> np.ndarray:
    return Rotation.from_euler(axes, degrees, degrees=True).as_matrix()


def _walking() -> list[Pose]:
    """Cameras that walk along a wall and look at it."""
    rng = np.random.default_rng(0)
    places = [np.array([0.4 * k - 3, rng.normal() * 0.05, 0]) for k in range(16)]
    return [(place, Rotation.from_rotvec(0.05 * rng.normal(size=3)).as_matrix()) for place in places]


def _facing(count: int) -> list[Pose]:
    """Cameras in an arc that look at one wall of a room."""
    shares = np.arange(count) / count
    return [(np.array([3.2 * share - 1.6, 0, -1.0]), _turn("y", 30 - 60 * share)) for share in shares]


def _write(path: Path, poses: list[Pose], seen: Callable[[int], np.ndarray], points: np.ndarray):
    """Write a database in which photos share the points (N, 3) that both see, and return the model of it.

    seen: by number of a photo the rows that it may show.
    """
    rng, model = np.random.default_rng(1), pycolmap.Reconstruction()
    database = pycolmap.Database.open(str(path))
    size, params = {"width": WIDTH, "height": HEIGHT}, [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]
    camera = pycolmap.Camera(model="PINHOLE", **size, params=params, camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    database.write_camera(camera, use_camera_id=True)
    database.write_rig(model.rigs[1], use_rig_id=True)
    rows, tracks = {}, [pycolmap.Track() for _ in points]
    for number, (place, turn) in enumerate(poses, 1):
        possible = seen(number - 1)
        pixels = np.asarray(camera.img_from_cam((points[possible] - place) @ turn.T))
        with np.errstate(invalid="ignore"):
            inside = ((pixels > 0) & (pixels < [WIDTH, HEIGHT])).all(1)
        rows[number] = possible[inside]
        pixels = (pixels[inside] + 0.2 * rng.standard_normal((inside.sum(), 2))).astype(np.float32)
        image = pycolmap.Image(name=f"{number - 1:02d}.jpg", keypoints=pixels, camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(turn), -(turn @ place)))
        database.write_frame(model.frames[number], use_frame_id=True)
        database.write_image(image, use_image_id=True)
        database.write_keypoints(number, pixels)
        for at, row in enumerate(rows[number]):
            tracks[row].add_element(number, at)
    for one in rows:
        for other in range(one + 1, len(poses) + 1):
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            _, *both = np.intersect1d(rows[one], rows[other], return_indices=True)
            geometry.inlier_matches = np.stack(both, 1).astype(np.uint32)
            database.write_two_view_geometry(one, other, geometry)
    database.close()
    for point, track in zip(points, tracks, strict=True):
        if track.length() > 1:
            model.add_point3D(point, track, np.zeros(3, np.uint8))
    return model


@pytest.mark.parametrize(("poses", "points", "turned"), [
    (_turning(0.0), _walls(4000, 0), True),
    (_turning(0.03), _walls(4000, 0), True),
    (_turning(0.3), _walls(4000, 0), False),
    (_walking(), _wall(4000, 0), False),
], ids=["in one place", "3 cm of noise", "30 cm of noise", "along a flat wall"])  # fmt: skip
def test_a_camera_that_only_turns_is_told_from_one_that_moves(tmp_path, poses, points, turned):
    path = tmp_path / "database.db"
    _write(path, poses, lambda _: np.arange(len(points)), points)
    found = JUDGED | {"rotation": rotation_error(str(path))}
    assert is_only_turned(found) == is_wrong(found) == turned


def _unmatched(model: pycolmap.Reconstruction, path: Path) -> list[str]:
    return find_cover([pair[:2] for pair in find_overlaps(model, str(path)) if pair.is_unmatched])


def test_rooms_with_one_poster_are_not_the_same_room(tmp_path):
    """Both lie on each other, and all matches agree; a room alone, of whose features others find a half, is right."""
    poster = np.random.default_rng(2).uniform(-1, 1, (300, 3)) * [0.6, 0.6, 0] + [0, 0, HALF[2]]
    points = np.concatenate([poster, _walls(4000, 0), _walls(4000, 1)])
    numbers, draws = np.arange(len(points)), np.random.default_rng(3)

    def seen(photo: int, rooms: int) -> np.ndarray:
        wall = 1 + photo % rooms
        rows = np.concatenate([numbers[:300], numbers[300 + 4000 * (wall - 1) : 300 + 4000 * wall]])
        return rows[draws.random(len(rows)) < 0.5]

    for rooms in (1, 2):
        path = tmp_path / f"{rooms}.db"
        alike = _unmatched(_write(path, _facing(20), lambda photo, rooms=rooms: seen(photo, rooms), points), path)
        found = JUDGED | {"alike": alike, "rotation": rotation_error(str(path))}
        assert is_folded(found) == is_wrong(found) == (rooms == 2)
        assert len(alike) >= 8 * (rooms - 1)
