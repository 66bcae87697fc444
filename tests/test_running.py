"""The clock that stands still while its process is stopped, and only then."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# Prints the seconds that the clock counts for each line that it reads.
CLOCK = """
import sys
from splatting.host.clock import running_seconds
WORK = {"hold the lock": lambda: sum(range(2 * 10**8)), "read": input}
began = running_seconds()
print("ready", flush=True)
WORK[sys.argv[1]]()
print(running_seconds() - began)
"""


def _counted(work: str, stopped: float = 0.0) -> tuple[float, float]:
    """Seconds that the clock counts for some work, and those of the wall. stopped: seconds of it."""
    command = [sys.executable, "-c", CLOCK, work]
    with subprocess.Popen(command, cwd=ROOT, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == "ready\n"
        began = time.monotonic()
        if stopped:
            time.sleep(0.5)
            process.send_signal(signal.SIGSTOP)
            time.sleep(stopped)
            process.send_signal(signal.SIGCONT)
        said, _ = process.communicate("\n")
        return float(said), time.monotonic() - began


def test_seconds_of_a_stopped_process_do_not_count():
    counted, wall = _counted("read", stopped=4.0)
    assert wall > 4.0 and counted < wall - 3.5


@pytest.mark.slow
def test_seconds_of_work_count_also_where_no_other_thread_may_look_at_the_clock():
    counted, wall = _counted("hold the lock")
    assert counted == pytest.approx(wall, abs=0.5)
