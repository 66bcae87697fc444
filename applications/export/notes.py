"""Notes of a page for its guests (--notes): a text file with a title, facts, and texts on views of training photos.

    # My room
    Author: A. Name
    Licence: CC BY 4.0
    What this place is.

    ## The window
    camera: IMG_0012.jpg
    at: 812 344
    Made in 1920.

Facts are lines `name: value` right below the title. A view's camera is the line below its name, and then a line may say
where in that photo the thing is: pixels from the left and from the top. The rest is text.
"""

import re
from pathlib import Path
from typing import NamedTuple

from groundwork.host.errors import UserError

_MOST = 25  # views, which the viewer takes
_LONGEST_TEXT = 1000  # letters of a note, which the viewer shows in a box
_NO_TEXT = re.compile(r"\s*([{<]|\[\s*[\[{\"])")  # JSON, RTF, HTML
_AT = re.compile(r"at:\s*(\d+(?:\.\d*)?)[\s,x]+(\d+(?:\.\d*)?)", re.IGNORECASE)
_FACT = re.compile(r"([^\W\d_][\w ]{0,30}):\s*(\S.*)")


class Note(NamedTuple):
    """A view with a name and a text. camera: the training photo that it is seen from.

    at: x and y in pixels of that photo, of the thing that is meant; None: what is in its middle.
    """

    name: str
    text: str
    camera: str
    at: tuple[float, float] | None = None


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
            title, facts, text = name, *_split_facts(lines)
            continue
        camera = _FACT.fullmatch(lines[0].strip()) if lines else None
        if not name or camera is None or camera[1].lower() != "camera":
            raise UserError(f"--notes {path}: “{name}” has no camera; write a name after ##, and camera: PHOTO below")
        at, said = None, lines[1].strip() if len(lines) > 1 else ""
        if re.match(r"at:\s*\d", said, re.IGNORECASE):
            at = _AT.fullmatch(said)
            if at is None:
                raise UserError(f"--notes {path}: “{name}” is {said}; give two numbers of pixels, such as at: 812 344")
            at = float(at[1]), float(at[2])
        words = "\n".join(lines[1 if at is None else 2 :]).strip()
        if len(words) > _LONGEST_TEXT:
            raise UserError(f"--notes {path}: “{name}” has {len(words):,} letters; shorten it to {_LONGEST_TEXT:,}")
        views.append(Note(name, words, camera[2], at))
    if len(views) > _MOST:
        raise UserError(f"--notes {path} has {len(views)} views, and a page takes {_MOST}; remove some")
    return Notes(title, facts, text, tuple(views))


def _split_facts(lines: list[str]) -> tuple[tuple[tuple[str, str], ...], str]:
    """The lines `name: value` at the beginning, and the text after them."""
    found = []
    while lines and (fact := _FACT.fullmatch(lines[0].strip())):
        found.append((fact[1], fact[2]))
        del lines[0]
    return tuple(found), "\n".join(lines).strip()
