"""Programs that work for minutes: run them with a log file and a progress bar, and end them when this process ends.

If this process is killed, it cannot end them. worker.py notices, because its input closes. Others, such as COLMAP, keep
working, and keep the lock on the log that they write to.
"""

import contextlib
import fcntl
import os
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import BinaryIO

from groundwork.host.interrupt import DeferredInterrupt
from groundwork.host.progress import Bar
from utils.system_utils import UserError

# worker.py is started by its path, and imports modules of the project.
_ROOT = str(Path(__file__).resolve().parents[2])
_FINDS = {"PYTHONPATH": os.pathsep.join(filter(None, [_ROOT, os.environ.get("PYTHONPATH")]))}
_PATIENCE = 5.0  # seconds that a program gets to end by itself
_TOLD = 0.05  # share of a stage, after which the time to go is guessed
_ORPHAN_PATIENCE = 2.0  # seconds that a worker gets to notice that its caller was killed


def run_programs(
    log: Path,
    commands: Sequence[Sequence[str]],
    title: str,
    total: int,
    done: Callable[[], int],
    hint: str = "",
    later: float = 0.0,
) -> None:
    """Run commands one after the other, append their output to `log`, and show `done()` of `total` as a bar.

    later: how much longer than this all later stages take, for a guess at the time to go over all; 0: not known.
    UserError with the last line of the output if a command fails. Ctrl-C and SIGTERM end the command first.
    """
    with Bar(total=total, desc=title, dynamic_ncols=True) as bar, open(log, "ab") as output:
        _lock(output)

        start = time.monotonic()

        def look() -> None:
            bar.update(min(max(done(), bar.n), total) - bar.n)
            if later and bar.n > _TOLD * total:
                whole = (time.monotonic() - start) * total / bar.n
                to_go = whole * (1 + later) - (time.monotonic() - start)
                bar.set_postfix_str(f"about {bar.format_interval(to_go)} for all", refresh=False)

        for command in commands:
            status = _run(command, output, look)
            if status:
                raise UserError(
                    f"{title.lower()} failed (status {status}: {_last_words(log)}); all output is in {log}{hint}"
                )
        bar.update(total - bar.n)  # the commands are done, whether or not `done` could count everything


def refuse_while_working(log: Path) -> None:
    """Raise UserError while a program of an earlier or another run still works and writes to this log."""
    if log.is_file():
        with open(log, "rb") as output:
            _lock(output)


def _lock(output: BinaryIO) -> None:
    """Lock a log, for this process and the programs that get it as their output, until the last of them has ended."""
    deadline = time.monotonic() + _ORPHAN_PATIENCE
    while True:
        try:
            fcntl.flock(output, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError as error:
            if time.monotonic() > deadline:
                raise UserError(
                    f"another convert.py, or a program that a killed one had started, still works in "
                    f"{Path(output.name).parent}; wait for it or end it (`fuser {output.name}` shows its process id)"
                ) from error
        except OSError:  # a file system without locks
            return
        time.sleep(0.05)


def _run(command: Sequence[str], output: BinaryIO, look: Callable[[], None]) -> int:
    with DeferredInterrupt() as interrupt:
        try:
            process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=output, stderr=subprocess.STDOUT, env=os.environ | _FINDS
            )
        except OSError as error:
            raise UserError(f"cannot run {command[0]} ({error.strerror}); pass the program's full path") from error
        try:
            while True:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(timeout=0.1)
                if interrupt.requested:  # before the status, since a signal to the group ends the program, too
                    raise interrupt.requested
                if process.returncode is not None:
                    return process.returncode
                look()
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
    return lines[-1][:300] if lines else "no output"
