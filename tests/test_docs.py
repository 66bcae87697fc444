"""README and docs: copied figures, and every command and flag that a page shows."""

import contextlib
import functools
import io
import re
import runpy
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest

import applications.demo  # noqa: F401  (pages are about the whole repository)
import benchmarks  # noqa: F401

ROOT = Path(__file__).resolve().parents[1]
NAMES = ("README", "CONTRIBUTING", "CHANGELOG", "SECURITY", "paper", "benchmarks/README")
PAGES = [
    *(ROOT / f"{name}.md" for name in NAMES),
    *sorted((ROOT / "docs").rglob("*.md")),
]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
# What benchmarks/device.sh runs by its first word.
DEVICE = {
    "kernels": "benchmarks.kernels.rasterizer",
    "accuracy": "benchmarks.accuracy.oracle",
    "train": "full_eval.py",
}
FOREIGN = {"--eval_steps", "--save_steps", "--nnodes", "--shutdown_timeout", "--set"}  # flags of other programs


def _name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def _prose(page: Path) -> str:
    """The page without its fenced blocks."""
    return FENCE.sub("", page.read_text(encoding="utf-8"))


def _commands(page: Path) -> Iterator[tuple[str, str, tuple[str, ...]]]:
    """The commands in a page's code, each with the page and the program, which is a file or a module.

    Code is fenced, indented, or within sentences. A backslash continues a line.
    """
    prose = _prose(page)
    code = [block for kind, block in FENCE.findall(page.read_text(encoding="utf-8")) if kind != "diff"]
    lines = [line for block in code for line in re.sub(r"\\\n\s*", "", block).splitlines()]
    lines += re.findall(r"^    .*", re.sub(r"\\\n\s*", "", prose), re.MULTILINE) + re.findall(r"`([^`\n]+)`", prose)
    for line in lines:
        for part in re.split(r"&&|\|\||;", re.sub(r"(^|\s)#.*", "", line)):
            words = [word.strip("[]'\",") for word in part.split()]
            while words and (re.fullmatch(r"\w+=.*", words[0]) or words[0] == "do"):
                del words[0]
            if words and (found := _program(words)):
                yield _name(page), found[0], tuple(found[1:])


def _program(words: list[str]) -> list[str] | None:
    """Program and words of a command line; None for a command of others (pytest, pip)."""
    if words[0] == "benchmarks/device.sh" and len(words) > 1 and words[1] in DEVICE:
        return [DEVICE[words[1]], *words[2:]]
    python = re.fullmatch(r"(\S*/)?python3?", words[0]) is not None
    rest = words[python:]
    if python and rest[:1] == ["-m"] and re.fullmatch(r"(benchmarks|splatting|scene)[a-z._]*", rest[1]):
        return rest[1:]
    return rest if rest and rest[0].endswith(".py") and (python or len(rest) > 1) else None


COMMANDS = sorted({command for page in PAGES for command in _commands(page)})
PROGRAMS = sorted({program for _, program, _ in COMMANDS})


@functools.cache
def _flags(program: str) -> frozenset[str]:
    """Every option that the program's help lists."""
    said = _help(program, "-h")
    if "--help-all" in said:
        said = _help(program, "--help-all")
    return frozenset(re.findall(r"(?<![\w-])--?[A-Za-z][\w-]*", said))


def _help(program: str, word: str) -> str:
    """Return the output of the program with one word. It runs in this process, as importing torch takes seconds."""
    said, argv, path = io.StringIO(), sys.argv, sys.path.copy()
    sys.argv = [program, word]
    try:
        with contextlib.redirect_stdout(said), warnings.catch_warnings(), pytest.raises(SystemExit) as ended:
            warnings.simplefilter("ignore")  # a module may be loaded already
            if program.endswith(".py"):
                runpy.run_path(str(ROOT / program), run_name="__main__")
            else:
                runpy.run_module(program, run_name="__main__")
    finally:
        sys.argv, sys.path[:] = argv, path
    assert not ended.value.code, said.getvalue()
    return said.getvalue()


@pytest.mark.parametrize("program", PROGRAMS)
def test_every_flag_shown_is_known(program):
    unknown = []
    for page, _, words in (command for command in COMMANDS if command[1] == program):
        known = _flags(program)
        for word in words:
            if word == "--":  # another program gets what follows
                known = _flags("train.py")
            elif re.match(r"--?[A-Za-z]", word) and word.split("=")[0] not in known:
                unknown.append((page, word))
    assert unknown == []


def test_every_flag_in_prose_is_known():
    known = frozenset().union(FOREIGN, *map(_flags, PROGRAMS))
    texts = {_name(page): _prose(page) for page in PAGES}
    removed = "".join(re.findall(r"(?ms)^### Removed$.*?(?=^##)", texts["CHANGELOG.md"]))
    gone = {("CHANGELOG.md", flag) for flag in re.findall(r"`(--\w+)", removed)}
    shown = {(name, flag) for name, text in texts.items() for flag in re.findall(r"`(--[a-z]\w+)[^`]*`", text)}
    assert {(name, flag) for name, flag in shown if flag not in known} <= gone


def test_links_resolve_in_the_repository():
    """The site checks its own."""
    links = [(page, link) for page in PAGES for link in re.findall(r"\]\((?!\w+:)([^()\s#]+)", _prose(page))]
    assert links and [(_name(page), link) for page, link in links if not (page.parent / link).exists()] == []


def test_the_worked_example_applies_to_the_code():
    """tests/test_extending.py, which is slow, also runs what it makes."""
    page = (ROOT / "docs/inside/extending.md").read_text(encoding="utf-8")
    diffs = "".join(re.findall(r"^```diff\n(.*?)^```$", page, re.MULTILINE | re.DOTALL))
    done = subprocess.run(["git", "apply", "--check", "-"], input=diffs, cwd=ROOT, capture_output=True, text=True)
    assert diffs and done.returncode == 0, f"bring the diffs of the page up to date: {done.stderr}"
