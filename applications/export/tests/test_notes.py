"""Notes for the guests of a page: the file that says them, and what the page makes of it."""

import json

import numpy as np
import pytest
from html_page import Page
from html_scene import CENTRE, UP, balls, cameras

from applications.export.html import write_html
from applications.export.notes import Note, Notes, read_notes
from applications.export.page_start import check_note
from utils.system_utils import UserError

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


@pytest.mark.parametrize(
    ("content", "said"),
    [
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
    ],
)
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
    assert [(mark["title"], mark["text"]) for mark in marks] == [
        ("The red one", "Redder: <b>than</b> you think."),
        ("The blue one", ""),
    ]
    for mark in marks:  # stands at the balls, which are 0.45 thick and 3.7 away
        assert 2.7 < np.linalg.norm(np.subtract(mark["position"], mark["camera"]["initial"]["position"])) < 4
    assert page.texts["title"] == "Two balls" and "<p>Author: A. Name</p>" in path.read_text(encoding="utf-8")
    write_html(path, balls(), cameras(), title="Mine", notes=read_notes(str(written)))
    assert Page(path).texts["title"] == "Mine"
    written.write_text("## Here\ncamera: nowhere", encoding="utf-8")
    with pytest.raises(UserError, match="--notes: nowhere is no training photo; there are photo_0.jpg"):
        write_html(path, balls(), cameras(), notes=read_notes(str(written)))
