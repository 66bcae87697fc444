"""The report as Markdown."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from evaluation.document import Block, Picture, Quote, Section, Table


def markdown_table(table: Table) -> str:
    """A Markdown table, padded so that it reads well in a terminal too."""
    lines = [[cell.replace("|", "\\|").replace("\n", " ") for cell in line] for line in (table.header, *table.rows)]
    widths = [max(max(len(line[i]) for line in lines), 3) for i in range(len(table.header))]
    rule = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
    padded = [
        [
            cell.ljust(width) if i == 0 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ]
        for line in (lines[0], rule, *lines[1:])
    ]
    return "\n".join("| " + " | ".join(line) + " |" for line in padded)


def _block(block: Block, folder: Path) -> str:
    if isinstance(block, Table):
        return markdown_table(block)
    if isinstance(block, Picture):
        return f"![{block.caption}]({quote(os.path.relpath(block.path, folder))})"
    if isinstance(block, Quote):
        return "\n".join(f"    {line}" for line in block.lines)
    return block


def to_markdown(title: str, sections: Sequence[Section], folder: Path) -> str:
    """The whole page; pictures are linked relative to `folder`, where it will lie."""
    parts = [f"# {title}"]
    for section in sections:
        parts += [f"## {section.title}", *(_block(block, folder) for block in section.blocks)]
    return "\n\n".join(parts) + "\n"
