"""Ends of a training from outside: SIGHUP, which waits for a safe moment as SIGTERM does, and kills."""

import os
import pty
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from groundwork.host.interrupt import DeferredInterrupt
from utils.system_utils import Terminated

ROOT = Path(__file__).parents[1]

# A program that writes to its terminal before and after each wait, and the result to a file.
WORK = """
import sys, time
from pathlib import Path
from groundwork.host.interrupt import DeferredInterrupt
with DeferredInterrupt() as interrupt:
    print("ready", flush=True)
    deadline = time.monotonic() + 60
    while not interrupt.requested and time.monotonic() < deadline:
        time.sleep(0.02)
    print("saving", flush=True)
    print("saving", file=sys.stderr, flush=True)
    Path(sys.argv[1]).write_text(interrupt.requested.__name__)
"""


def test_work_goes_on_when_the_terminal_is_closed(tmp_path):
    said = tmp_path / "said"
    child, terminal = pty.fork()
    if child == 0:
        os.chdir(ROOT)
        os.execv(sys.executable, [sys.executable, "-c", WORK, str(said)])
    try:
        assert os.read(terminal, 5) == b"ready"
    finally:
        os.close(terminal)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert said.read_text() == "Terminated"


def test_a_second_hangup_is_not_impatience():
    before = signal.getsignal(signal.SIGHUP)
    with DeferredInterrupt() as interrupt:
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGHUP)
        assert interrupt.requested is Terminated
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGHUP) == before


def test_nohup_is_respected():
    program = (
        "import os, signal; from groundwork.host.interrupt import DeferredInterrupt\n"
        "with DeferredInterrupt() as interrupt: os.kill(os.getpid(), signal.SIGHUP); print(interrupt.requested)"
    )
    command = ["sh", "-c", 'trap \'\' HUP; exec "$0" -c "$1"', sys.executable, program]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "None\n"


# One trial of killed trainings


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
def test_a_killed_training_ends_as_if_it_had_not_been():
    done = subprocess.run([sys.executable, "-m", "tests.kills", "2", "4"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0 and "0 ended differently" in done.stdout, done.stdout + done.stderr
