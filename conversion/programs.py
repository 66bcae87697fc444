"""Programs that work for minutes: run with a log file and a progress bar, ended with us."""

import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from tqdm import tqdm

from utils.interrupt import DeferredInterrupt
from utils.system_utils import UserError

_PATIENCE = 5.0  # seconds for a program to end by itself


def run_programs(
    commands: Sequence[Sequence[str]], log: Path, title: str, total: int, done: Callable[[], int], hint: str = ""
) -> None:
    """Run commands one after the other, output appended to `log`; a bar shows `done()` of `total` pictures or pairs.

    UserError with the program's last words when one fails. Ctrl-C and SIGTERM end the program before they go on.
    """
    with tqdm(total=total, desc=title, dynamic_ncols=True) as bar, open(log, "ab") as output:

        def look() -> None:
            bar.update(min(max(done(), bar.n), total) - bar.n)

        for command in commands:
            status = _run(command, output, look)
            if status:
                raise UserError(
                    f"{title.lower()} failed (status {status}: {_last_words(log)}); the whole story is in {log}{hint}"
                )
        bar.update(total - bar.n)  # what can't be counted is done as well


def _run(command: Sequence[str], output, look: Callable[[], None]) -> int:
    with DeferredInterrupt() as interrupt:
        try:
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT)
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
