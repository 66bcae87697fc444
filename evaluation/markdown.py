"""The report as Markdown."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from evaluation.document import Block, Picture, Quote, Section, Table
from utils.files.markdown_table import markdown_table


def _block(block: Block, folder: Path) -> str:
    if isinstance(block, Table):
        return markdown_table(block.header, block.rows)
    if isinstance(block, Picture):
        return f"![{block.caption}]({quote(os.path.relpath(block.path, folder))})"
    if isinstance(block, Quote):
        return "\n".join(f"    {line}" for line in block.lines)
    return block


def to_markdown(title: str, sections: Sequence[Section], folder: Path) -> str:
    """Render the whole page; links to figures are relative to `folder`, the folder of the page."""
    parts = [f"# {title}"]
    for section in sections:
        parts += [f"## {section.title}", *(_block(block, folder) for block in section.blocks)]
    return "\n\n".join(parts) + "\n"
