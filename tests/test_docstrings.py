"""The first words of every module."""

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# A docstring names its module's subject or says what the module does. A clause without a head does neither.
HEADLESS = ("What", "Which", "How", "Where", "Whether")
MADE = ("build", "eval", "output")  # folders of make, full_eval.py and the demo; virtual environments begin with a dot


def _is_ours(path: Path) -> bool:
    return not any(part in MADE or part.startswith(".") for part in path.relative_to(ROOT).parts)


def _first_word(path: Path) -> str:
    docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return docstring.split(maxsplit=1)[0] if docstring else ""


def test_module_docstrings_begin_with_a_noun_or_a_verb():
    paths = [path for path in ROOT.rglob("*.py") if _is_ours(path)]
    assert len(paths) > 100
    assert [path.relative_to(ROOT).as_posix() for path in paths if _first_word(path) in HEADLESS] == []
