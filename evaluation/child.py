"""A subprocess whose messages are shown and kept, and which is stopped the way it wants to be stopped."""

from __future__ import annotations

import contextlib
import os
import re
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

from utils.host.interrupt import DeferredInterrupt
from utils.system_utils import Terminated

LINES = 20  # of its stderr that are kept
_LOOK = 0.2  # seconds between looks for Ctrl-C


@dataclass(frozen=True)
class Finished:
    """How a subprocess ended: exit status (negative: by that signal), last lines of stderr, wall-clock seconds."""

    status: int
    lines: list[str]
    seconds: float
    interrupt: type[KeyboardInterrupt] | None

    @property
    def reason(self) -> str:
        """One line: what it said last, or how it ended."""
        if self.status < 0:
            return f"killed by {signal.Signals(-self.status).name}"
        return self.lines[-1] if self.lines else f"exit status {self.status}"


def run_child(command: Sequence[str]) -> Finished:
    """Run a command (no shell), copying its stderr to ours.

    Ctrl-C or SIGTERM to us is handed on once, SIGHUP (a closed terminal) as SIGTERM, and what the child then does
    (train.py saves a checkpoint) is waited for; `interrupt` says so. A second one kills it and raises.
    """
    start = time.perf_counter()
    tail = _Tail()
    # A session of its own: else the terminal's Ctrl-C would reach it beside ours, and train.py takes two as "at once".
    with DeferredInterrupt() as interrupt:
        # Inherits only what is inheritable: the folder's lock, so that it is kept as long as this child lives.
        child = subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True, close_fds=False)
        try:
            handed_on = False
            with selectors.DefaultSelector() as selector:
                selector.register(child.stderr, selectors.EVENT_READ)
                while True:
                    if interrupt.requested and not handed_on:
                        handed_on = True
                        child.send_signal(signal.SIGTERM if interrupt.requested is Terminated else signal.SIGINT)
                    if selector.select(_LOOK):
                        if not (chunk := os.read(child.stderr.fileno(), 1 << 16)):
                            break
                        tail.add(chunk)
                        _show(chunk)
            status = child.wait()
        finally:
            if child.poll() is None:
                child.kill()
                child.wait()
            child.stderr.close()
        requested = interrupt.requested
    return Finished(status, tail.lines, time.perf_counter() - start, requested)


def _show(chunk: bytes) -> None:
    with contextlib.suppress(OSError):
        sys.stderr.write(chunk.decode("utf-8", "replace"))
        sys.stderr.flush()


class _Tail:
    """The last lines of a stream; of a line redrawn with carriage returns (a progress bar) nothing."""

    def __init__(self) -> None:
        self._text = b""

    def add(self, chunk: bytes) -> None:
        self._text = (self._text + chunk)[-(1 << 16) :]

    @property
    def lines(self) -> list[str]:
        lines = (line.rsplit("\r", 1)[-1] for line in self._text.decode("utf-8", "replace").split("\n"))
        kept = [line.rstrip() for line in lines if line.strip() and not re.search(r"\d+%\|", line)]
        return kept[-LINES:]
