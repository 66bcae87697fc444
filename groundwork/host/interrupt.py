"""Ctrl-C, SIGTERM and SIGHUP as exceptions, at once or deferred to a safe moment; children that Ctrl-C spares."""

import contextlib
import os
import signal
import threading
from collections.abc import Iterable
from types import FrameType, TracebackType


class Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP, raised like Ctrl-C's KeyboardInterrupt."""


_ENDS = (signal.SIGTERM, signal.SIGHUP)
_ERRORS = {signal.SIGINT: KeyboardInterrupt} | dict.fromkeys(_ENDS, Terminated)


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
        """Take over the signals that end a program, in the main thread; a hangup only where it is not ignored."""
        if threading.current_thread() is threading.main_thread():
            for signum in _ERRORS:
                if signum != signal.SIGHUP or signal.getsignal(signum) != signal.SIG_IGN:
                    self._previous[signum] = signal.signal(signum, self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Give the signals back to their former handlers."""
        for signum, handler in self._previous.items():
            if handler is not None:
                signal.signal(signum, handler)

    def _note(self, signum: int, frame: FrameType | None) -> None:
        """Note a signal for later; raise its error at once if one was noted before."""
        if signum == signal.SIGHUP:
            _leave_closed_terminal()
        elif self.requested:
            raise _ERRORS[signum]
        self.requested = self.requested or _ERRORS[signum]


def raise_on_signals() -> None:
    """Let SIGTERM and SIGHUP raise Terminated, as Ctrl-C raises KeyboardInterrupt, so that no half-done file is left.

    Signals that are ignored or handled stay so. Only the main thread may call this.
    """
    for signum in _ENDS:
        if signal.getsignal(signum) == signal.SIG_DFL:
            signal.signal(signum, _terminate)


def let_signals_end() -> None:
    """Let SIGTERM and SIGHUP end the process again, as nothing half-done is left that Python's own end would leave."""
    for signum in _ENDS:
        if signal.getsignal(signum) == _terminate:
            signal.signal(signum, signal.SIG_DFL)


def ignore(signals: Iterable[int] = tuple(_ERRORS)) -> None:
    """Ignore these signals from now on."""
    for signum in signals:
        signal.signal(signum, _pass_over)


def _pass_over(signum: int, frame: FrameType | None) -> None:
    """Do nothing. Programs that are started from now on do not inherit it, as they would signal.SIG_IGN."""


def _terminate(signum: int, frame: FrameType | None) -> None:
    ignore(_ENDS)  # several senders may tell one process to end, and what follows removes half-done files
    if signum == signal.SIGHUP:
        _leave_closed_terminal()
    raise Terminated


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
