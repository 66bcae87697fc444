"""The report as Markdown."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from evaluation.blocks import Block, Comparison, Link, Picture, Quote, Section, Table
from utils.files.markdown_table import markdown_table

_MEANT = re.compile(r"[\\`*\[\]<>&]")  # characters that begin or end links, emphasis, code and HTML
_ENTITIES = {"<": "&lt;", ">": "&gt;", "&": "&amp;"}


def plain(text: str) -> str:
    """Escape a text, so that names in it appear as they are: no link, no HTML, no second line."""
    safe = _MEANT.sub(lambda match: _ENTITIES.get(match[0], f"\\{match[0]}"), text)
    return " ".join(safe.splitlines())


def table_text(table: Table) -> str:
    """Render a table, its cells escaped."""
    return markdown_table([plain(cell) for cell in table.header], [[plain(cell) for cell in row] for row in table.rows])


def _block(block: Block, folder: Path) -> str:
    if isinstance(block, Table):
        return table_text(block)
    if isinstance(block, Picture):
        return f"![{plain(block.caption)}]({quote(os.fsencode(os.path.relpath(block.path, folder)))})"
    if isinstance(block, Link):
        return f"[{plain(block.text)}]({quote(os.fsencode(block.target))})"
    if isinstance(block, Quote):
        return "\n".join(f"    {line}" for text in block.lines for line in text.splitlines())
    return re.sub(r"^\s*([#+=~-])", r"\\\1", plain(block))  # no heading, no list


def to_markdown(title: str, sections: Sequence[Section], folder: Path) -> str:
    """Render the whole page; links to figures are relative to `folder`, the folder of the page."""
    parts = [f"# {title}"]
    for section in sections:
        parts += [f"## {plain(section.title)}"]
        # Comparisons are for the page alone: their pictures are in no file.
        parts += [_block(block, folder) for block in section.blocks if not isinstance(block, Comparison)]
    return "\n\n".join(parts) + "\n"
