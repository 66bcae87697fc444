"""Seconds of this process: since it started, and those in which it was not stopped.

A process is stopped by Ctrl-Z, or on a machine that sleeps.
"""

import os
import threading
import time
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


class _Running(threading.Thread):
    def __init__(self) -> None:
        super().__init__(name="ticks", daemon=True)
        self._lock = threading.Lock()
        self._seconds, self._before, self._worked = 0.0, time.monotonic(), _worked()

    def seconds(self) -> float:
        with self._lock:
            now, worked = time.monotonic(), _worked()
            passed = now - self._before
            if passed < _STOPPED or worked - self._worked > _WORKED:
                self._seconds += passed
            self._before, self._worked = now, worked
            return self._seconds

    def run(self) -> None:
        while True:
            time.sleep(_TICK)
            self.seconds()


def _worked() -> float:
    """CPU seconds of the main thread; of all threads where the system does not tell."""
    try:
        return time.clock_gettime(time.pthread_getcpuclockid(threading.main_thread().ident))
    except (AttributeError, OSError):
        return time.process_time()


_clock: _Running | None = None


def running_seconds() -> float:
    """Seconds in which this process was not stopped. Only differences have a meaning; the first call starts a thread.

    Stops of less than 2 seconds count as running.
    """
    global _clock
    if _clock is None or not _clock.is_alive():  # in a process that was forked it is not
        _clock = _Running()
        _clock.start()
    return _clock.seconds()
