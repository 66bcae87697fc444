"""Seconds since this process started, and seconds in which it ran.

A process is stopped by Ctrl-Z, or on a machine that sleeps.
"""

import os
import threading
import time
import weakref
from pathlib import Path

_IMPORTED = time.perf_counter()
_TICK = 0.25  # seconds
# Seconds without a tick after which the process was stopped, unless the main thread has worked meanwhile: it may keep
# others from Python's lock. On a busy machine ticks come late, but by much less.
_STOPPED = 2.0
_WORKED = 2 * _TICK  # seconds of work that do not fit into the time between a tick and a stop


def seconds_since_start(process: int | None = None) -> float | None:
    """Seconds since this process, or another one, started, to a clock tick; None if the system does not say."""
    try:
        # The command's name, in brackets, may have spaces. Field 22 of proc(5) is the start in clock ticks since boot.
        fields = Path(f"/proc/{process or 'self'}/stat").read_text().rpartition(")")[2].split()
        started = int(fields[22 - 3]) / os.sysconf("SC_CLK_TCK")
        least = 0.0 if process else time.perf_counter() - _IMPORTED
        return max(time.clock_gettime(time.CLOCK_BOOTTIME) - started, least)
    except (OSError, ValueError, IndexError, AttributeError):
        return None


def wall_seconds() -> float:
    """Seconds since the process started, or since the import of this module if the system does not say."""
    known = seconds_since_start()
    return time.perf_counter() - _IMPORTED if known is None else known


class _Running:
    """Counts seconds in which the process was not stopped; the clock must be read every two seconds (`tick`)."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._seconds, self._before, self._worked = 0.0, time.monotonic(), _read_cpu_seconds()

    def seconds(self) -> float:
        """Return the seconds so far, without the time in which the process was stopped."""
        with self._lock:
            now, worked = time.monotonic(), _read_cpu_seconds()
            passed = now - self._before
            if passed < _STOPPED or worked - self._worked > _WORKED:
                self._seconds += passed
            self._before, self._worked = now, worked
            return self._seconds


def _read_cpu_seconds() -> float:
    """CPU seconds of the main thread; of all threads where the system does not tell."""
    try:
        return time.clock_gettime(time.pthread_getcpuclockid(threading.main_thread().ident))
    except (AttributeError, OSError):
        return time.process_time()


_clock = _Running()


def _begin_anew() -> None:
    global _clock
    _clock = _Running()


os.register_at_fork(after_in_child=_begin_anew)  # there, no other thread looks at the clock or gives back its lock


def running_seconds() -> float:
    """Seconds in which this process was not stopped. Only differences count, and while a user of `tick` lives.

    Stops of less than 2 seconds count as running.
    """
    return _clock.seconds()


def tick(user: object) -> None:
    """Let a thread read the clock while `user` lives; without reads, a process that waits counts as stopped."""
    threading.Thread(target=_look_while, args=(weakref.ref(user),), name="ticks", daemon=True).start()


def _look_while(user: weakref.ref) -> None:
    while user() is not None:
        time.sleep(_TICK)
        _clock.seconds()
