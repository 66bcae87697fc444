"""Ctrl-C, SIGTERM and SIGHUP, deferred until the program can stop cleanly."""

import contextlib
import os
import signal
import threading
from types import FrameType, TracebackType

_HANGUP = getattr(signal, "SIGHUP", None)  # Windows has none


class Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP, raised like Ctrl-C's KeyboardInterrupt."""


_ERRORS = {signal.SIGINT: KeyboardInterrupt, signal.SIGTERM: Terminated}
if _HANGUP is not None:
    _ERRORS[_HANGUP] = Terminated


class DeferredInterrupt:
    """Inside `with`, a first Ctrl-C, SIGTERM or SIGHUP only sets `requested`, so that no half-done step gets saved.

    requested: the exception to raise at a safe moment: KeyboardInterrupt, Terminated (for SIGTERM, and for SIGHUP of a
    closed terminal), or None. A second signal raises its exception at once, except SIGHUP, which both terminal and
    shell may send. Under nohup SIGHUP stays ignored. Outside the main thread, where Python delivers no signals, this
    does nothing.
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
    """Redirect closed outputs to nowhere; otherwise the next message would end the program before it has saved."""
    for descriptor in (1, 2):
        try:
            os.write(descriptor, b"")
        except OSError:
            with contextlib.suppress(OSError):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, descriptor)
                os.close(nowhere)
