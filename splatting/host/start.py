"""Start of a command: Ctrl-C and garbage while its modules are imported, outputs that are closed or refuse letters, and
memory that the process keeps.

Importing torch makes half a million objects that stay. Python's collector would go through them several times meanwhile
and once more at the end, which takes a third of the seconds of a process that does nothing else.
"""

import gc
import io
import os
import signal
import sys
import threading

from splatting.host.interrupt import raise_on_signals
from splatting.host.kept_memory import keep_freed_memory

_waiting = False  # whether the collector is


def prepare() -> None:
    """Call before a command's imports, which take a second: Ctrl-C then ends it at once, without a traceback.

    Python raises KeyboardInterrupt inside whatever is being imported, and some packages swallow it. A SIGINT that is
    ignored, as in the background of a shell, stays ignored.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    global _waiting
    _waiting = gc.isenabled()
    gc.disable()
    open_outputs()
    keep_freed_memory()


def imported() -> None:
    """Call when all is imported: signals raise exceptions from now on, and garbage is collected, but for the imports.

    Without `prepare`, as where other code calls this, its garbage is its own.
    """
    global _waiting
    if _waiting:
        gc.freeze()
        gc.enable()
        _waiting = False
    if threading.current_thread() is threading.main_thread():
        if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        raise_on_signals()
    open_outputs()


def open_outputs() -> None:
    """Let an output that is closed (`>&-`) lead nowhere, and one that cannot write a letter write its number."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            nowhere = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  (open to the end)
            setattr(sys, name, nowhere)
            setattr(sys, f"__{name}__", nowhere)
        elif isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")
