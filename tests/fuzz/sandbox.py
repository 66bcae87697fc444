"""A child process for the cases, replaced when one crashes or hangs."""

import json
import os
import select
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
WORKER = ("-m", "fuzz.worker")
START, CASE = 120, 40  # seconds until the child is ready, and most for a case; the machine may be busy


class Sandbox:
    """Runs cases by kind and number. Use it in a `with` block."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._child: subprocess.Popen | None = None
        self.worst: dict[str, tuple[int, float]] = {}  # by kind: most bytes and seconds that a case has added

    def __enter__(self) -> "Sandbox":
        return self

    def __exit__(self, *error: object) -> None:
        self._end()

    def run(self, kind: str, number: int) -> str | None:
        """The finding of a case, None if there is none."""
        if self._child is None:
            self._begin()
        self._child.stdin.write(f"{kind} {number}\n".encode())
        self._child.stdin.flush()
        answer = self._answer(CASE)
        if answer is None:
            self._child.kill()
        if not answer:
            status = self._child.wait()
            log = Path(self._folder.name, "log").read_text(errors="replace")[-2000:]
            self._end()
            said = signal.Signals(-status).name if status < 0 else f"status {status}"
            return f"hangs for more than {CASE} s" if answer is None else f"ended with {said}\n{log}"
        finding, more, seconds = json.loads(answer)
        self.worst[kind] = tuple(map(max, self.worst.get(kind, (0, 0.0)), (more, seconds)))
        return finding

    def _begin(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="fuzz")
        folder = Path(self._folder.name)
        environment = os.environ | {
            "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tests'}",
            "OMP_NUM_THREADS": "1",
            "GS_CACHE": str(folder / "cache"),
        }
        command = [sys.executable, *WORKER, str(self._seed), str(folder)]
        with open(folder / "log", "ab") as log:
            pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": log}
            self._child = subprocess.Popen(command, cwd=ROOT, env=environment, **pipes)
        if not self._answer(START):
            raise RuntimeError(f"the worker did not start: {(folder / 'log').read_text(errors='replace')[-2000:]}")

    def _answer(self, seconds: float) -> bytes | None:
        """A line; empty when the child has ended, None when it does not answer in time."""
        ready, _, _ = select.select([self._child.stdout], [], [], seconds)
        return self._child.stdout.readline() if ready else None

    def _end(self) -> None:
        if self._child is not None:
            self._child.kill()
            self._child.communicate()
            self._child = None
            self._folder.cleanup()
