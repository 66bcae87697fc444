"""Ctrl-C and SIGTERM that wait for a good moment."""

import signal
import threading
from types import FrameType, TracebackType

from utils.system_utils import Terminated

_ERRORS = {signal.SIGINT: KeyboardInterrupt, signal.SIGTERM: Terminated}


class DeferredInterrupt:
    """Inside `with`, a first Ctrl-C or SIGTERM only sets `requested`, so that no half-done step gets saved.

    requested: the exception to raise in a good moment, KeyboardInterrupt or Terminated, or None. A second signal raises
    its own at once. Outside the main thread, where Python delivers no signals, it does nothing.
    """

    def __init__(self) -> None:
        self.requested: type[KeyboardInterrupt] | None = None
        self._previous = {}

    def __enter__(self) -> "DeferredInterrupt":
        if threading.current_thread() is threading.main_thread():
            self._previous = {signum: signal.signal(signum, self._note) for signum in _ERRORS}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        for signum, handler in self._previous.items():
            if handler is not None:
                signal.signal(signum, handler)

    def _note(self, signum: int, frame: FrameType | None) -> None:
        if self.requested:
            raise _ERRORS[signum]
        self.requested = _ERRORS[signum]
