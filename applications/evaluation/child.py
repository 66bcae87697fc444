"""A subprocess whose messages are kept, and which gets time to save when it is interrupted; several, each on a GPU."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from typing import TypeVar

from groundwork.host.interrupt import DeferredInterrupt
from utils.system_utils import Terminated

LINES = 20  # lines of stderr to keep
_LOOK = 0.2  # seconds between checks for Ctrl-C
Item = TypeVar("Item")


@dataclass(frozen=True)
class Finished:
    """The end of a subprocess."""

    status: int  # exit status; negative: the signal that killed it
    lines: list[str]  # last lines of stderr; what ended it, if nothing else tells
    wall_seconds: float
    cpu_seconds: float  # of all its threads
    interrupt: type[KeyboardInterrupt] | None  # the interrupt that this process got meanwhile


@dataclass(frozen=True)
class Slot:
    """A GPU for one child at a time, as others have theirs. gpu: CUDA_VISIBLE_DEVICES of the child."""

    gpu: str
    interrupt: DeferredInterrupt  # of the main thread, which gets the signals for all
    ended: threading.Event = field(default_factory=threading.Event)  # the child is to be killed


def run_child(command: Sequence[str], say: str = "", slot: Slot | None = None, **environment: str) -> Finished:
    """Run a command without a shell. environment: variables beside our own.

    slot: None: this is the only child; what it does is said first, and its stderr is copied to ours.

    Ctrl-C or SIGTERM to this process is passed on once, SIGHUP (a closed terminal) as SIGTERM. Then this function waits
    for the child, since train.py saves a checkpoint, and sets `interrupt`. A second signal kills the child and raises.
    """
    if say and not slot:
        print(f"  {say}", flush=True)
    start = time.perf_counter()
    visible = {"CUDA_VISIBLE_DEVICES": slot.gpu} if slot else {}
    # The child gets its own session. Otherwise the terminal's Ctrl-C would reach it twice, directly and through us, and
    # train.py stops at once on the second one.
    with contextlib.nullcontext(slot.interrupt) if slot else DeferredInterrupt() as interrupt:
        if interrupt.requested:
            raise interrupt.requested
        # The child inherits only the folder's lock, which is then kept as long as the child lives.
        child = subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True, close_fds=False,
                                 env=os.environ | visible | environment)  # fmt: skip
        tail = bytearray()
        reader = threading.Thread(target=_read, args=(child, tail, slot is None), daemon=True)
        reader.start()
        try:
            handed_on = False
            while reader.is_alive():
                if interrupt.requested and not handed_on:
                    handed_on = True
                    child.send_signal(signal.SIGTERM if interrupt.requested is Terminated else signal.SIGINT)
                if slot and slot.ended.is_set():
                    child.kill()
                reader.join(_LOOK)
            cpu = _wait_for(child)
        finally:
            if child.poll() is None:
                child.kill()
                child.wait()
            reader.join(_LOOK)  # longer only if a program that the child has started holds the pipe
            if not reader.is_alive():
                child.stderr.close()
        requested, status = interrupt.requested, child.returncode
    lines = _list_last_lines(tail)
    if status < 0:
        lines.append(f"killed by {signal.Signals(-status).name}")
    return Finished(status, lines or [f"exit status {status}"], time.perf_counter() - start, cpu, requested)


def share_gpus(items: Iterable[Item], gpus: Sequence[str], do: Callable[[Item, Slot], None]) -> None:
    """Call `do` with each item and with a GPU as soon as one is free; `do` runs children by `run_child`.

    Ctrl-C and other signals end all of them, as in `run_child`, and are raised.
    """
    waiting = iter(list(items))

    def work(slot: Slot) -> None:
        with contextlib.suppress(KeyboardInterrupt):  # that of the main thread, which is raised there
            while not slot.interrupt.requested and (item := next(waiting, None)) is not None:
                do(item, slot)

    with DeferredInterrupt() as interrupt, ThreadPoolExecutor(len(gpus)) as pool:
        slots = [Slot(gpu, interrupt) for gpu in gpus]
        working = [pool.submit(work, slot) for slot in slots]
        try:
            while wait(working, _LOOK).not_done:
                pass
        finally:  # after a second signal children still run
            for slot in slots:
                slot.ended.set()
    for one in working:
        one.result()
    if interrupt.requested:
        raise interrupt.requested


def _read(child: subprocess.Popen, tail: bytearray, shown: bool) -> None:
    """Keep the end of a child's messages, and show them."""
    while chunk := os.read(child.stderr.fileno(), 1 << 16):
        tail[:] = (tail + chunk)[-(1 << 16) :]
        if shown:
            with contextlib.suppress(OSError):
                sys.stderr.write(chunk.decode("utf-8", "replace"))
                sys.stderr.flush()


def _wait_for(child: subprocess.Popen) -> float | None:
    """Wait for a child's end; return the CPU seconds of it and its children, None if it was waited for already."""
    try:
        _, status, usage = os.wait4(child.pid, 0)
    except ChildProcessError:  # it ended as it was told to
        child.wait()
        return None
    child.returncode = os.waitstatus_to_exitcode(status)
    return usage.ru_utime + usage.ru_stime


def _list_last_lines(tail: bytearray) -> list[str]:
    """The last lines, without progress bars, which redraw their line with carriage returns."""
    lines = (line.rsplit("\r", 1)[-1] for line in tail.decode("utf-8", "replace").split("\n"))
    return [line.rstrip() for line in lines if line.strip() and not re.search(r"\d+%\|", line)][-LINES:]
