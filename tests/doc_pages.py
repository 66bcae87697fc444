"""README, docs and the commands that they show."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")),
    *sorted((ROOT / "benchmarks").glob("README.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
# Rooms with modules that are commands; other modules (pytest, pip) are not ours.
ROOMS = ("benchmarks", "splatting", "scene")
# What benchmarks/device.sh runs by its first word.
DEVICE = {
    "kernels": "benchmarks.kernels.rasterizer",
    "accuracy": "benchmarks.accuracy.oracle",
    "train": "benchmarks.scenes.training",
}


class Command(NamedTuple):
    """A command of ours that a page shows."""

    page: str
    program: str  # train.py, or a module as benchmarks.kernels.rasterizer
    words: tuple[str, ...]


def name_of(page: Path) -> str:
    """The page's path in the repository."""
    return page.relative_to(ROOT).as_posix()


def prose(page: Path) -> str:
    """The page without its fenced blocks."""
    return FENCE.sub("", page.read_text(encoding="utf-8"))


def commands(page: Path) -> Iterator[Command]:
    """The commands in a page's code, in the order of their kinds: fenced, indented, within sentences."""
    for line in _code(page):
        for part in re.split(r"&&|\|\||;", re.sub(r"(^|\s)#.*", "", line)):
            words = [word.strip("[]'\",") for word in part.split()]
            while words and (re.fullmatch(r"\w+=.*", words[0]) or words[0] == "do"):
                del words[0]
            if found := _program(words):
                yield Command(name_of(page), *found)


def _code(page: Path) -> Iterator[str]:
    text = page.read_text(encoding="utf-8")
    fenced = [code for kind, code in FENCE.findall(text) if kind != "diff"]
    indented = [line for line in _joined(prose(page)) if line.startswith("    ")]
    yield from (line for code in fenced for line in _joined(code))
    yield from indented
    yield from re.findall(r"`([^`\n]+)`", prose(page))


def _joined(text: str) -> list[str]:
    """Lines, those that a backslash continues made one."""
    return re.sub(r"\\\n\s*", "", text).splitlines()


def _program(words: list[str]) -> tuple[str, tuple[str, ...]] | None:
    """Program and words of a command line, None where it is no command of ours."""
    if not words:
        return None
    if words[0] == "benchmarks/device.sh" and len(words) > 1 and words[1] in DEVICE:
        return DEVICE[words[1]], tuple(words[2:])
    python = re.fullmatch(r"(\S*/)?python3?", words[0]) is not None
    rest = words[python:]
    if python and rest[:1] == ["-m"] and rest[1].split(".")[0] in ROOMS and rest[1].islower():  # ROOM.NAME is none
        return rest[1], tuple(rest[2:])
    if rest and rest[0].endswith(".py") and (python or len(rest) > 1):
        return rest[0], tuple(rest[1:])
    return None
