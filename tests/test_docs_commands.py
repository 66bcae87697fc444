"""Every command and every flag that README and docs show exists."""

import contextlib
import functools
import io
import re
import runpy
import sys
import warnings
from collections.abc import Sequence

import pytest
from doc_pages import PAGES, ROOT, commands, name_of, prose

COMMANDS = sorted({command for page in PAGES for command in commands(page)})
PROGRAMS = sorted({command.program for command in COMMANDS})
# Programs that hand words which they do not know to train.py.
FORWARDING = (
    "benchmarks.scenes.step_profile",
    "benchmarks.scenes.training",
)
# Flags of other programs.
FOREIGN = {"--eval_steps", "--save_steps", "--nnodes", "--shutdown_timeout"}


@functools.cache
def _flags(program: str) -> frozenset[str]:
    """Every option that `-h` lists. In this process, as importing torch takes seconds."""
    said, argv, path = io.StringIO(), sys.argv, sys.path.copy()
    sys.argv = [program, "-h"]
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
    return frozenset(re.findall(r"(?<![\w-])--?[A-Za-z][\w-]*", said.getvalue()))


def _options(words: Sequence[str]) -> list[str]:
    return [word.split("=")[0] for word in words if re.match(r"--?[A-Za-z]", word)]


def test_the_docs_show_every_command():
    assert {"train.py", "render.py", "metrics.py", "full_eval.py", "convert.py", "doctor.py"} <= set(PROGRAMS)
    assert any(program.startswith("benchmarks.") for program in PROGRAMS)


@pytest.mark.parametrize("program", PROGRAMS)
def test_every_flag_shown_is_known(program):
    unknown = []
    for command in (command for command in COMMANDS if command.program == program):
        words, to_train = command.words, ()
        if "--" in words:  # full_eval.py hands what follows to train.py
            words, to_train = words[: words.index("--")], words[words.index("--") :]
        known = _flags(program) | (_flags("train.py") if program in FORWARDING else frozenset())
        wrong = [flag for flag in _options(words) if flag not in known]
        wrong += [flag for flag in _options(to_train) if flag not in _flags("train.py")]
        unknown += [(command.page, flag) for flag in wrong]
    assert unknown == []


def test_every_flag_in_prose_is_known():
    known = frozenset().union(FOREIGN, *map(_flags, PROGRAMS))
    shown = {(name_of(page), flag) for page in PAGES for flag in re.findall(r"`(--[a-z]\w+)[^`]*`", prose(page))}
    assert {(page, flag) for page, flag in shown if flag not in known} == set()
