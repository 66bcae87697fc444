"""Blocks of the report, for both renderings: paragraphs, tables, figures and quoted messages; and texts of cells."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Table:
    """A table of text cells; the first column is aligned to the left, the others to the right."""

    header: list[str]
    rows: list[list[str]]


@dataclass(frozen=True)
class Picture:
    """A PNG on disk, with an absolute path."""

    path: Path
    caption: str


@dataclass(frozen=True)
class Quote:
    """Messages of a program, verbatim."""

    lines: list[str]


@dataclass(frozen=True)
class Link:
    """A file beside the report. target: its path relative to the report's folder."""

    text: str
    target: str


@dataclass(frozen=True)
class Comparison:
    """A test view, each picture as the bytes of a JPEG: photo, render, and their amplified difference."""

    caption: str
    photo: bytes
    render: bytes
    error: bytes


Block = str | Table | Picture | Quote | Link | Comparison


@dataclass(frozen=True)
class Section:
    """A title and the blocks under it."""

    title: str
    blocks: list[Block] = field(default_factory=list)


def number(value: float | None, digits: int) -> str:
    """Format a number for a cell; None becomes -."""
    return "-" if value is None else f"{value:,.{digits}f}"


def spread_cell(spread: Mapping[str, Any], digits: int) -> str:
    """Format mean and standard deviation of a `summary.spread`."""
    deviation = "" if spread["std"] is None else f" ± {spread['std']:,.{digits}f}"
    return number(spread["mean"], digits) + deviation


def run_title(run: Mapping[str, Any]) -> str:
    """Name a run by scene, option set and seed."""
    seed = None if run["seed"] is None else f"seed {run['seed']}"
    return ", ".join(part for part in (run["scene"], run["config"], seed) if part)
