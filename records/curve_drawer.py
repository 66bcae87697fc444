"""Drawing of error_vs_time.png in a process of its own: matplotlib takes a second, and training has other things to do.

That process runs this module as a command. It imports matplotlib, reads from its standard input what to draw, draws it,
and prints what went wrong. If its input ends before, it draws nothing.
"""

import contextlib
import gc
import json
import subprocess
import sys
from pathlib import Path

from records.curve_figure import draw_curve
from records.error_curve import Row
from utils.host.session import own_session

_ROOT = Path(__file__).resolve().parents[1]


class CurveDrawer:
    """Draws one curve. `begin`, `draw` and `finish` are called in that order; `abandon` at any time.

    Where matplotlib is loaded, or no process can be started, `finish` draws here.
    """

    def __init__(self) -> None:
        self._process: subprocess.Popen | None = None
        self._request: tuple[Path, list[Row], str] | None = None

    def begin(self) -> None:
        """Start the process, unless that was done, so that it imports matplotlib meanwhile."""
        if self._process is not None or "matplotlib" in sys.modules or not sys.executable:
            return
        command = [sys.executable, "-X", "utf8", "-m", "records.curve_drawer"]
        with contextlib.suppress(OSError):
            self._process = subprocess.Popen(
                command, cwd=_ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, encoding="utf-8",
                **own_session(),  # Ctrl-C is for the training, which ends this process if need be
            )  # fmt: skip

    def draw(self, path: Path, rows: list[Row], title: str) -> None:
        """Give what to draw: arguments of `draw_curve`."""
        self._request = path, rows, title
        if self._process is not None:
            with contextlib.suppress(OSError):  # it has ended, and `finish` says so
                json.dump([str(path.absolute()), rows, title], self._process.stdin)
                self._process.stdin.close()

    def finish(self) -> str | None:
        """Wait until it is drawn. Returns what went wrong, None if nothing did."""
        if self._process is None:
            return _failure(*self._request)
        try:
            said = self._process.stdout.read().strip()
            status = self._process.wait()
        finally:
            self.abandon()  # if a signal has interrupted the waiting
        return said or (f"the process that draws it ended with status {status}" if status else None)

    def abandon(self) -> None:
        """End the process, if there is one."""
        if self._process is None:
            return
        self._process.kill()
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(OSError):
                pipe.close()
        self._process.wait()


def _failure(path: Path, rows: list[Row], title: str) -> str | None:
    try:
        draw_curve(path, rows, title)
    except Exception as error:  # a broken matplotlib may raise anything, and the model is trained
        return f"{type(error).__name__}: {error}"
    return None


def main() -> None:
    gc.disable()  # for the second that this takes
    with contextlib.suppress(Exception):  # drawing reports it
        import matplotlib.backends.backend_agg
        import matplotlib.figure  # noqa: F401
    request = sys.stdin.read()
    if request:
        path, rows, title = json.loads(request)
        print(_failure(Path(path), rows, title) or "")


if __name__ == "__main__":
    main()
