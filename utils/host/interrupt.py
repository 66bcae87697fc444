"""Ctrl-C, SIGTERM and SIGHUP that wait for a good moment."""

import contextlib
import os
import signal
import threading
from types import FrameType, TracebackType

_HANGUP = getattr(signal, "SIGHUP", None)  # Windows has none


class Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP, where it is treated as Ctrl-C is."""


_ERRORS = {signal.SIGINT: KeyboardInterrupt, signal.SIGTERM: Terminated}
if _HANGUP is not None:
    _ERRORS[_HANGUP] = Terminated


class DeferredInterrupt:
    """Inside `with`, a first Ctrl-C, SIGTERM or SIGHUP only sets `requested`, so that no half-done step gets saved.

    requested: the exception to raise in a good moment, KeyboardInterrupt or Terminated (SIGTERM; SIGHUP, when the
    terminal is closed), or None. A second signal raises its own at once, but SIGHUP, which may come once from the
    terminal and once from the shell. Under nohup SIGHUP stays ignored. Outside the main thread, where Python delivers
    no signals, it does nothing.
    """

    def __init__(self) -> None:
        self.requested: type[KeyboardInterrupt] | None = None
        self._previous = {}

    def __enter__(self) -> "DeferredInterrupt":
        if threading.current_thread() is threading.main_thread():
            for signum in _ERRORS:
                if signum != _HANGUP or signal.getsignal(signum) != signal.SIG_IGN:
                    self._previous[signum] = signal.signal(signum, self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        for signum, handler in self._previous.items():
            if handler is not None:
                signal.signal(signum, handler)

    def _note(self, signum: int, frame: FrameType | None) -> None:
        if signum == _HANGUP:
            _leave_closed_terminal()
        elif self.requested:
            raise _ERRORS[signum]
        self.requested = self.requested or _ERRORS[signum]


def _leave_closed_terminal() -> None:
    """Send to nowhere what can no longer be written, or the next message would end the program before it has saved."""
    for descriptor in (1, 2):
        try:
            os.write(descriptor, b"")
        except OSError:
            with contextlib.suppress(OSError):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, descriptor)
                os.close(nowhere)
