"""What a page tells its guests (--notes): a text file with a title, facts, and notes on views of training photos.

    # My room
    Author: A. Name
    Licence: CC BY 4.0
    What this place is.

    ## The window
    camera: IMG_0012.jpg
    Made in 1920.

Facts are lines `name: value` right below the title, and a view's camera is the line below its name. The rest is text.
"""

import re
from pathlib import Path
from typing import NamedTuple

from splatting.host.errors import UserError

_MOST = 25  # views, which the viewer takes
_LONGEST_TEXT = 1000  # letters of a note, which the viewer shows in a box
_NO_TEXT = re.compile(r"\s*([{<]|\[\s*[\[{\"])")  # JSON, RTF, HTML
_FACT = re.compile(r"([^\W\d_][\w ]{0,30}):\s*(\S.*)")


class Note(NamedTuple):
    """A view with a name and a text. camera: the training photo that it is seen from."""

    name: str
    text: str
    camera: str


class Notes(NamedTuple):
    """title: empty if the file has none. facts: such as author, date and licence, in the order of the file."""

    title: str = ""
    facts: tuple[tuple[str, str], ...] = ()
    text: str = ""
    views: tuple[Note, ...] = ()


def read_notes(path: str) -> Notes:
    """The notes of a file. UserError where it cannot be read, or where a note lacks its camera."""
    try:
        content = Path(path).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"--notes {path} cannot be read as UTF-8 text ({error}); give a text file") from error
    if _NO_TEXT.match(content):
        raise UserError(f"--notes {path} is no plain text; write it as docs/guide/web_pages.md shows, from # Title on")
    before, *parts = re.split(r"^(##?)[ \t]+(.*)$", content, flags=re.MULTILINE)
    title, facts, text, views = "", (), before.strip(), []
    for place, (marks, heading, body) in enumerate(zip(parts[::3], parts[1::3], parts[2::3], strict=True)):
        name, lines = heading.strip(), body.strip().splitlines()
        if marks == "#":
            if place or text or not name:
                raise UserError(f"--notes {path}: “# {name}” is not the first line; begin views with ##")
            title, facts, text = name, *_facts_of(lines)
            continue
        camera = _FACT.fullmatch(lines[0].strip()) if lines else None
        if not name or camera is None or camera[1].lower() != "camera":
            raise UserError(f"--notes {path}: “{name}” has no camera; write a name after ##, and camera: PHOTO below")
        words = "\n".join(lines[1:]).strip()
        if len(words) > _LONGEST_TEXT:
            raise UserError(f"--notes {path}: “{name}” has {len(words):,} letters; shorten it to {_LONGEST_TEXT:,}")
        views.append(Note(name, words, camera[2]))
    if len(views) > _MOST:
        raise UserError(f"--notes {path} has {len(views)} views, and a page takes {_MOST}; remove some")
    return Notes(title, facts, text, tuple(views))


def _facts_of(lines: list[str]) -> tuple[tuple[tuple[str, str], ...], str]:
    """The lines `name: value` at the beginning, and the text after them."""
    found = []
    while lines and (fact := _FACT.fullmatch(lines[0].strip())):
        found.append((fact[1], fact[2]))
        del lines[0]
    return tuple(found), "\n".join(lines).strip()
