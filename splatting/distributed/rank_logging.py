"""Outputs of several ranks: rank 0 prints, and what only others have to say on stderr is told with their names."""

import os
import sys
from collections.abc import Mapping, Sequence
from functools import partialmethod
from typing import TextIO

from tqdm import tqdm

_MOST = 200  # lines that are kept


class Noted:
    """A stderr whose whole lines are noted. Those of rank 0 are printed as well."""

    def __init__(self, stream: TextIO, printed: bool) -> None:
        self.stream, self.printed = stream, printed
        self.lines: list[str] = []
        self._begun = ""

    def write(self, text: str) -> int:
        *whole, self._begun = (self._begun + text).split("\n")
        # Progress bars return to the beginning of their line, and are cleared in front of others.
        ends = [line.rpartition("\r")[2] for line in whole]
        self.lines = [*self.lines, *(line for line in ends if line.strip())][-_MOST:]
        if self.printed:
            self.stream.write(text)
        return len(text)

    def __getattr__(self, name: str) -> object:
        return getattr(self.stream, name)


_noted: Noted | None = None


def hush(first: bool) -> None:
    """Let this rank, unless it is the first, print nothing and show no progress bar."""
    global _noted
    sys.stderr = _noted = Noted(sys.stderr, first)
    if not first:
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  (open to the end)
        tqdm.__init__ = partialmethod(tqdm.__init__, disable=True)


def take() -> list[str]:
    """What this rank has said on stderr. The others' lines are forgotten with it, as they are about to be told."""
    if _noted is None:
        return []
    lines = list(_noted.lines)
    if not _noted.printed:
        _noted.lines.clear()
    return lines


def unhush() -> None:
    """Let this rank print on stderr whatever it is told to, as the traceback of a bug."""
    if _noted:
        sys.stderr = _noted.stream


def speak(line: str) -> None:
    """Print a line on stderr, from whatever rank."""
    print(line, file=_noted.stream if _noted else sys.stderr, flush=True)


def tell(said: Mapping[int, Sequence[str]]) -> None:
    """Print the lines of other ranks that rank 0 has not printed, each with the ranks that say it."""
    known = set(_noted.lines) if _noted and _noted.printed else set()
    ranks: dict[str, list[int]] = {}
    for rank, lines in sorted(said.items()):
        for line in dict.fromkeys(lines):
            if rank and line not in known:
                ranks.setdefault(line, []).append(rank)
    for line, those in ranks.items():
        speak(f"{names(those)}: {line}")
    if _noted and _noted.printed:
        _noted.lines += ranks


def names(ranks: Sequence[int]) -> str:
    """Ranks in words: "rank 1", "ranks 1, 2"."""
    return f"rank{'s' * (len(ranks) > 1)} {', '.join(map(str, ranks))}"
