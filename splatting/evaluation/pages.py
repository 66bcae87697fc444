"""The report's two pages, both made from the sections of `document`: HTML by report.html.jinja, and Markdown.

The HTML file is self-contained: figures are embedded, and its one script moves sliders over pictures.
"""

from __future__ import annotations

import base64
import io
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import jinja2
from PIL import Image

from splatting.evaluation.document import Block, Section
from splatting.files.markdown_table import markdown_table

_PHOTOGRAPHIC = 1 << 18  # bytes of a PNG above which a JPEG replaces it
_QUALITY = 90
_MEANT = re.compile(r"[\\`*\[\]<>&]")  # characters that begin or end links, emphasis, code and HTML
_ENTITIES = {"<": "&lt;", ">": "&gt;", "&": "&amp;"}


def to_html(title: str, sections: Sequence[Section]) -> str:
    """Render the page as HTML."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {"data_uri": _data_uri, "jpeg": _uri, "url": _url}
    return environment.get_template("report.html.jinja").render(title=title, sections=sections)


def _data_uri(path: Path) -> str:
    """Return a figure as a data: URI; large ones become JPEG."""
    content = path.read_bytes()
    if len(content) <= _PHOTOGRAPHIC:
        return _uri(content, "png")
    buffer = io.BytesIO()
    with Image.open(path) as image:
        image.convert("RGB").save(buffer, "JPEG", quality=_QUALITY)
    return _uri(buffer.getvalue())


def _uri(content: bytes, kind: str = "jpeg") -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def _url(path: str) -> str:
    return quote(os.fsencode(path))


def to_markdown(title: str, sections: Sequence[Section], folder: Path) -> str:
    """Render the page as Markdown; links to figures are relative to `folder`, the folder of the page."""
    parts = [f"# {title}"]
    for heading, blocks in sections:
        parts += [f"## {_plain(heading)}", *filter(None, (_block(block, folder) for block in blocks))]
    return "\n\n".join(parts) + "\n"


def _block(block: Block, folder: Path) -> str:
    if isinstance(block, str):
        return re.sub(r"^\s*([#+=~-])", r"\\\1", _plain(block))  # no heading, no list
    if "rows" in block:
        return table_text(block)
    if "quote" in block:
        return "\n".join(f"    {line}" for text in block["quote"] for line in text.splitlines())
    if "link" in block:
        return f"[{_plain(block['text'])}]({_url(block['link'])})"
    if "photo" in block:
        return ""  # for HTML alone: these pictures are in no file
    return f"![{_plain(block['text'])}]({_url(os.path.relpath(block['picture'], folder))})"


def table_text(table: Mapping[str, Any]) -> str:
    """Render a table as Markdown, its cells escaped."""
    header, *rows = [[_plain(cell) for cell in row] for row in (table["header"], *table["rows"])]
    return markdown_table(header, rows)


def _plain(text: str) -> str:
    """Escape a text, so that names in it appear as they are: no link, no HTML, no second line."""
    safe = _MEANT.sub(lambda match: _ENTITIES.get(match[0], f"\\{match[0]}"), text)
    return " ".join(safe.splitlines())
