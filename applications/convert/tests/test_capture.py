"""The report of a capture: what it finds and advises, its page, and what train.py says of it."""

import json
import re

import numpy as np
import pytest
from PIL import Image, ImageFilter
from scipy.ndimage import gaussian_filter

import train
from applications.convert import report
from applications.convert.capture_page import write_page
from applications.convert.checks import (
    check_reconstruction,
    describe_capture,
    find_gaps,
    find_neighbours,
    rate_capture,
    why_unusable,
)
from applications.convert.layout import Layout
from applications.convert.photo_quality import compare_brightness, measure_looks
from scene.checks.conversion import describe_left_out
from scene.checks.photos import SHARED_TEXT
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
    assert [line.split(":")[0] for line in found["again"]] == [
        "Take photos on the way from e.jpg to the others, each overlapping the one before by 60 to 80 %",
        "Take more photos around d.jpg", "Hold the camera still, or add light, for b.jpg",
        "Use a fixed exposure, if you can",
    ]  # fmt: skip
    assert found["again"][-1].endswith("--appearance ppisp")
    assert describe_capture(_report(4, 5, "e.jpg") | found)[:2] == [
        "overlap: 1 of 4 photos weakly connected (d.jpg)", "blur: 1 of 5 photos blurred (b.jpg)",
    ]  # fmt: skip


def test_where_photos_are_missing_is_said():
    """The placed photos around a hole name it; single photos, and those at an end of a folder, are none."""
    placed = ["0.jpg", "3.jpg", "5.jpg", "9.jpg", "a/1.jpg", "a/5.jpg"]
    left = ["1.jpg", "2.jpg", "4.jpg", "6.jpg", "7.jpg", "8.jpg", "a/0.jpg", "a/6.jpg", "b/1.jpg", "b/2.jpg"]
    assert find_gaps(left, placed) == [(3, "5.jpg", "9.jpg"), (2, "0.jpg", "3.jpg")]
    photos = {name: {"shared": {other: 99 for other in placed if other != name}} for name in placed}
    report = _report(6, 16, *left) | {"tried": [{"against": ["1.jpg", "4.jpg"]}]}
    said = rate_capture(report, photos, {})["again"]
    assert said[:2] == [
        "Take photos between 5.jpg and 9.jpg: 3 there could not be placed",
        "Take photos between 0.jpg and 3.jpg: 2 there could not be placed",
    ]
    assert len(said) == 3 and said[2].startswith("Take photos on the way from a/0.jpg, a/6.jpg, b/1.jpg, b/2.jpg to")
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
    assert [(name, re.findall('"problem">(.*?)<', card)) for name, card in cards] == [
        ("b.jpg", ["blurred"]), ("d.jpg", ["weakly connected"]), ("e&lt;&amp;.jpg", ["not placed"]),
        ("f.jpg", ["left out: too few other photos match it"]), ("a.jpg", []), ("c.jpg", []),
    ]  # fmt: skip
    assert "<dt>neighbours</dt><dd>2</dd>" in cards[0][1] and "<dt>matching photos</dt><dd>0</dd>" in cards[2][1]
    assert [re.findall("brightness</dt><dd>(.*?)<", card) for _, card in cards[1:5]] == [["-2.0"], [], [], ["+0.0"]]
    assert text.count("data:image/jpeg;base64,") == len(NAMES) and "e<&" not in text
    assert re.findall('<a href="#photo(.)"( class="weak")?.*?<title>(.*?)</title>', text) == [
        ("5", "", "c.jpg"), ("4", "", "a.jpg"), ("1", ' class="weak"', "d.jpg"), ("0", "", "b.jpg"),
    ]  # fmt: skip
    assert '<li class="problem">4 of 6 photos placed' in text and "<li>Take more photos around d.jpg" in text


@pytest.mark.parametrize(("placed", "said"), [(5, True), (6, False), (10, False)])
def test_too_few_photos_are_said(placed, said):
    text = why_unusable(_report(placed, 10))
    assert (text is not None) == said and (not said or "only 5 of 10 photos" in text)


def test_a_training_says_what_its_scene_lacks(tmp_path):
    assert describe_left_out(tmp_path) is None
    path = tmp_path / "convert_report.json"
    path.write_text(json.dumps(_report(14, 30)))
    assert describe_left_out(tmp_path).startswith("this scene has 14 of 30 photos (47%) of its capture")
    path.write_text(json.dumps(_report(30, 30)))
    assert describe_left_out(tmp_path) is None
    path.write_text("[]")
    assert describe_left_out(tmp_path) is None


@pytest.mark.parametrize(
    ("given", "kept", "said"),
    [("native", "undistort", True), ("native", "native", False), ("auto", "undistort", False)],
)
def test_a_training_says_that_native_lenses_come_too_late(colmap_scene, tmp_path, capsys, given, kept, said):
    (colmap_scene / "convert_report.json").write_text(json.dumps(_report(17, 17) | {"lenses": kept}))
    words = ["-s", str(colmap_scene), "-m", str(tmp_path / "out"), "-r", "24", "--iterations", "1", "--quiet"]
    train.main([*words, "--lenses", given, "--no_curve", "--test_iterations", "-1"])
    text = "warning: --lenses native has no effect, since convert.py undistorted the photos of this scene; to train on"
    assert (text in capsys.readouterr().err) == said


@pytest.mark.parametrize("name", ["../a.png", "/a.png", "deep/../../a.png"])
def test_photos_of_a_model_stay_in_their_folder(tmp_path, name):
    layout = Layout(tmp_path)
    layout.work.mkdir()
    model = report.Model("0", [name], 1, 1.0, 1.0, [])
    layout.survey.write_text(json.dumps([model._asdict()]))
    with pytest.raises(UserError, match="names a photo .*a.png, outside of the folder of its photos"):
        report.read_survey(layout, [])


def _model(registered: int, points: int = 5000, track: float = 5.0, error: float = 0.5, first: int = 0) -> report.Model:
    return report.Model("0", [f"{i:03d}" for i in range(first, first + registered)], points, track, error, [])


def test_poses_that_no_pair_judged_are_not_called_right():
    photos = [f"{i:03d}" for i in range(40)]
    words = [_model(40)], photos, dict.fromkeys(photos, 3), "auto", 0
    (line,) = map(str, check_reconstruction(*words, tried=[{"way": "global", "photos": 40, "pairs": 0}]))
    assert line.startswith("the poses could not be judged")
    judged = {"way": "global", "photos": 40, "pairs": 90, "agreeing": 40, "contradicting": 0.02}
    assert [*check_reconstruction(*words, tried=[judged])] == []


@pytest.mark.parametrize(
    ("models", "said"),
    [
        ([_model(40)], []),
        ([_model(38)], [r"2 of 40 photos left out \(038, 039\), 1 of them without a match .*else; --matcher"]),
        ([_model(25), _model(15, first=25)], ["15 of 40", r"form 2 unconnected parts \(25 photos are used, the oth"]),
        ([_model(40), _model(12)], []),
        ([_model(40, points=900)], ["only 900 points; .*1000; use larger .* photos, or --max_num_features 16384$"]),
        ([_model(40, track=2.4)], ["in 2.4 photos on average, so the photos overlap little"]),
        ([_model(40, error=2.0)], ["mean reprojection error is 2.0 pixels"]),
    ],
)
def test_advice(models, said):
    photos = [f"{i:03d}" for i in range(40)]
    lines = [*map(str, check_reconstruction(models, photos, dict.fromkeys(photos[:39], 3), "sequential", 8192))]
    assert [bool(re.search(expected, line)) for line, expected in zip(lines, said, strict=True)] == [True] * len(said)


def test_per_photo_is_not_advised_to_who_has_it():
    photos = [f"{i:03d}" for i in range(40)]
    wrong = {"way": "global", "photos": 40, "pairs": 90, "agreeing": 9, "contradicting": 0.9, "against": photos[:2]}
    words = [_model(25, error=9.0), _model(15, first=25)], photos, dict.fromkeys(photos, 9), "auto", 0, [wrong], 0
    advised = [
        ["per_photo" in line for line in map(str, check_reconstruction(*words, mode))]
        for mode in ("per_lens", "per_photo")
    ]
    assert advised[0].count(True) == 4 and not any(advised[1])
