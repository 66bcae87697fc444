"""Notes for the guests of a page: the file that says them, and what the page makes of it."""

import json

import numpy as np
import pytest
from html_scene import balls, cameras
from test_html_export import Page

from splatting.exports.html import write_html
from splatting.exports.notes import Note, Notes, read_notes
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


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"## Here\nText", "“Here” has no camera; write a name after ##, and camera: PHOTO below"),
        (b"## \ncamera: a.jpg", "“” has no camera; write a name after ##"),
        (b"# One\n# Two", "“# Two” is not the first line; begin views with ##"),
        (b"Text\n# One", "“# One” is not the first line; begin views with ##"),
        (b"## Here\ncamera: a.jpg\n" + 1001 * b"x", "“Here” has 1,001 letters; shorten it to 1,000"),
        (26 * b"## Here\ncamera: a.jpg\n", "has 26 views, and a page takes 25; remove some"),
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
