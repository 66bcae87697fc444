"""A subprocess whose messages are shown and kept, and which gets time to save when it is interrupted."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass

from splatting.host.interrupt import DeferredInterrupt
from utils.system_utils import Terminated

try:
    import resource
except ImportError:  # Windows
    resource = None

LINES = 20  # lines of stderr to keep
_LOOK = 0.2  # seconds between checks for Ctrl-C


@dataclass(frozen=True)
class Finished:
    """The end of a subprocess."""

    status: int  # exit status; negative: the signal that killed it
    lines: list[str]  # last lines of stderr; what ended it, if nothing else tells
    wall_seconds: float
    cpu_seconds: float | None  # of all its threads; None where the system does not tell
    interrupt: type[KeyboardInterrupt] | None  # the interrupt that this process got meanwhile


def run_child(command: Sequence[str], **environment: str) -> Finished:
    """Run a command without a shell, and copy its stderr to ours. environment: variables beside our own.

    Ctrl-C or SIGTERM to this process is passed on once, SIGHUP (a closed terminal) as SIGTERM. Then this function waits
    for the child, since train.py saves a checkpoint, and sets `interrupt`. A second signal kills the child and raises.
    """
    start, cpu_before = time.perf_counter(), _children_cpu_seconds()
    # The child gets its own session. Otherwise the terminal's Ctrl-C would reach it twice, directly and through us, and
    # train.py stops at once on the second one.
    with DeferredInterrupt() as interrupt:
        # The child inherits only the folder's lock, which is then kept as long as the child lives.
        child = subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True, close_fds=False,
                                 env=os.environ | environment)  # fmt: skip
        tail = bytearray()
        # Windows cannot wait for a pipe with a time limit.
        reader = threading.Thread(target=_read, args=(child, tail), daemon=True)
        reader.start()
        try:
            handed_on = False
            while reader.is_alive():
                if interrupt.requested and not handed_on:
                    handed_on = True
                    _hand_on(interrupt.requested, child)
                reader.join(_LOOK)
            status = child.wait()
        finally:
            if child.poll() is None:
                child.kill()
                child.wait()
            reader.join(_LOOK)  # longer only if a program that the child has started holds the pipe
            if not reader.is_alive():
                child.stderr.close()
        requested = interrupt.requested
    cpu = None if cpu_before is None else _children_cpu_seconds() - cpu_before
    lines = _lines(tail)
    if status < 0:
        lines.append(f"killed by {signal.Signals(-status).name}")
    return Finished(status, lines or [f"exit status {status}"], time.perf_counter() - start, cpu, requested)


def _read(child: subprocess.Popen, tail: bytearray) -> None:
    """Show a child's messages, and keep their end."""
    while chunk := os.read(child.stderr.fileno(), 1 << 16):
        tail[:] = (tail + chunk)[-(1 << 16) :]
        with contextlib.suppress(OSError):
            sys.stderr.write(chunk.decode("utf-8", "replace"))
            sys.stderr.flush()


def _lines(tail: bytearray) -> list[str]:
    """The last lines, without progress bars, which redraw their line with carriage returns."""
    lines = (line.rsplit("\r", 1)[-1] for line in tail.decode("utf-8", "replace").split("\n"))
    return [line.rstrip() for line in lines if line.strip() and not re.search(r"\d+%\|", line)][-LINES:]


def _hand_on(interrupt: type[KeyboardInterrupt], child: subprocess.Popen) -> None:
    if os.name != "nt":  # there Ctrl-C has reached the child as well, and no other signal can be sent
        child.send_signal(signal.SIGTERM if interrupt is Terminated else signal.SIGINT)


def _children_cpu_seconds() -> float | None:
    """CPU seconds of all child processes that have ended; None where the system does not tell."""
    if resource is None:
        return None
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime
