"""Progress bars: one line that is redrawn on a terminal, and a new line now and then in a log file."""

import time
from collections.abc import Callable, Iterable
from typing import Any

from tqdm import tqdm
from tqdm.contrib.concurrent import thread_map

from groundwork.host.machine import threads

INTERVAL = 10.0  # seconds between the lines in a log


class Bar(tqdm):
    """tqdm's bar; a file or a pipe gets a line at most every INTERVAL seconds, and one at the end."""

    def __init__(self, *args: Any, **options: Any) -> None:
        self._shown, self._line = time.monotonic(), ""
        super().__init__(*args, **options)

    @property
    def _logs(self) -> bool:
        return not getattr(self.fp, "isatty", bool)()

    def display(self, msg: str | None = None, pos: int | None = None) -> bool | None:
        """Show the bar, or in a log nothing unless a line is due."""
        if not self._logs:
            return super().display(msg, pos)
        if time.monotonic() - self._shown >= INTERVAL:
            self._write()
        return True

    def clear(self, nolock: bool = False) -> None:
        """Remove the bar in front of other lines; those of a log stay."""
        if not self.disable and not self._logs:
            super().clear(nolock)

    def close(self) -> None:
        """End the bar, in a log with a last line."""
        if self.disable or not self._logs:
            return super().close()
        self.disable = True
        type(self)._decr_instances(self)
        if self.leave and self.n:
            self._write()
        return None

    def _write(self) -> None:
        """Write the bar's text as a line of its own, unless it is the line before."""
        self._shown, line = time.monotonic(), str(self).strip()
        if line != self._line:
            self._line = line
            self.fp.write(f"{line}\n")
            getattr(self.fp, "flush", lambda: None)()


def in_threads(work: Callable[..., Any], *jobs: Iterable[Any], **options: Any) -> list[Any]:
    """Map jobs to their results, in order, on as many threads as the processor has, behind a bar with `options`."""
    return thread_map(work, *jobs, max_workers=threads(), tqdm_class=Bar, dynamic_ncols=True, **options)
