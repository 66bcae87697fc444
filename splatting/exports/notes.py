"""What a page tells its guests (--notes): a Markdown file with a title, facts, and notes on views of training photos.

    # My room
    author: A. Name
    date: May 2026
    licence: CC BY 4.0
    What this place is.

    ## The window
    camera: IMG_0012.jpg
    Made in 1920.

Lines `key: value` follow a heading at once; the rest is text. Any key of the title is a fact.
"""

import re
from pathlib import Path
from typing import NamedTuple

from splatting.host.errors import UserError

_MOST = 25  # views, which the viewer takes
_LONGEST_TEXT = 1000  # letters of a note, which the viewer shows in a box
_FACT = re.compile(r"([^\W\d_][\w ]{0,30}):\s+(\S.*)")


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
        raise UserError(f"--notes {path} cannot be read as UTF-8 text ({error}); give a Markdown file") from error
    parts = re.split(r"^(##?)[ \t]+(.*)$", content, flags=re.MULTILINE)
    title, facts, text, views = "", (), parts[0].strip(), []
    for marks, heading, body in zip(parts[1::3], parts[2::3], parts[3::3], strict=True):
        found, words = _facts_of(body)
        if marks == "#":
            title, facts, text = heading.strip(), tuple(found.items()), words
            continue
        camera = found.pop("camera", "")
        if not camera:
            raise UserError(f"--notes {path}: “{heading}” has no camera; write camera: PHOTO in the line below it")
        if len(words) > _LONGEST_TEXT:
            raise UserError(f"--notes {path}: “{heading}” has {len(words):,} letters; shorten it to {_LONGEST_TEXT:,}")
        views.append(Note(heading.strip(), words, camera))
    if len(views) > _MOST:
        raise UserError(f"--notes {path} has {len(views)} views, and a page takes {_MOST}; remove some")
    return Notes(title, facts, text, tuple(views))


def _facts_of(body: str) -> tuple[dict[str, str], str]:
    """The lines `key: value` at the beginning of a part, and the text after them."""
    lines, found = body.strip().splitlines(), {}
    while lines and (fact := _FACT.fullmatch(lines[0].strip())):
        found[fact[1].lower()] = fact[2]
        del lines[0]
    return found, "\n".join(lines).strip()
