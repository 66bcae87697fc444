"""One trial of killed trainings."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
def test_a_killed_training_ends_as_if_it_had_not_been():
    done = subprocess.run([sys.executable, "-m", "tests.kills", "2", "4"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0 and "0 ended differently" in done.stdout, done.stdout + done.stderr
