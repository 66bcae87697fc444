"""Programs that work for minutes: run with a log file and a progress bar, ended with us.

Where we are killed at once, nothing can end them. worker.py notices (its input closes); others, such as COLMAP, work
on, and still hold the lock on the log that they write to.
"""

import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import BinaryIO

from tqdm import tqdm

from utils.host.interrupt import DeferredInterrupt
from utils.system_utils import UserError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

_PATIENCE = 5.0  # seconds for a program to end by itself
_ORPHAN_PATIENCE = 2.0  # seconds for a worker to notice that its caller was killed


def run_programs(
    commands: Sequence[Sequence[str]], log: Path, title: str, total: int, done: Callable[[], int], hint: str = ""
) -> None:
    """Run commands one after the other, output appended to `log`; a bar shows `done()` of `total` pictures or pairs.

    UserError with the program's last words when one fails. Ctrl-C and SIGTERM end the program before they go on.
    """
    with tqdm(total=total, desc=title, dynamic_ncols=True) as bar, open(log, "ab") as output:
        _lock(output)

        def look() -> None:
            bar.update(min(max(done(), bar.n), total) - bar.n)

        for command in commands:
            status = _run(command, output, look)
            if status:
                raise UserError(
                    f"{title.lower()} failed (status {status}: {_last_words(log)}); the whole story is in {log}{hint}"
                )
        bar.update(total - bar.n)  # what can't be counted is done as well


def refuse_while_working(log: Path) -> None:
    """UserError while a program of an earlier run, or of another one, still works and writes to this log."""
    if log.is_file():
        with open(log, "rb") as output:
            _lock(output)


def _lock(output: BinaryIO) -> None:
    """Lock a log, for us and for the programs that get it as their output, until the last of them has ended."""
    deadline = time.monotonic() + _ORPHAN_PATIENCE
    while fcntl:
        try:
            fcntl.flock(output, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError as error:
            if time.monotonic() > deadline:
                raise UserError(
                    f"another convert.py, or a program that a killed one had started, still works in "
                    f"{Path(output.name).parent}; wait for it or end it (`fuser {output.name}` shows its process)"
                ) from error
        except OSError:  # a file system without locks
            return
        time.sleep(0.05)


def _run(command: Sequence[str], output: BinaryIO, look: Callable[[], None]) -> int:
    with DeferredInterrupt() as interrupt:
        try:
            process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=output, stderr=subprocess.STDOUT)
        except OSError as error:
            raise UserError(f"cannot run {command[0]} ({error.strerror}); name a program with its path") from error
        try:
            while True:
                try:
                    return process.wait(timeout=0.1)
                except subprocess.TimeoutExpired:
                    look()
                if interrupt.requested:
                    raise interrupt.requested
        finally:
            _end(process)
            process.stdin.close()


def _end(process: subprocess.Popen) -> None:
    if process.poll() is not None:
        return
    process.terminate()
    deadline = time.monotonic() + _PATIENCE
    while process.poll() is None:
        if time.monotonic() > deadline:
            process.kill()
        time.sleep(0.02)


def _last_words(log: Path) -> str:
    lines = [line.strip() for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    return lines[-1][:300] if lines else "it said nothing"
