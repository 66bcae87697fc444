"""Memory that is freed and taken again, as each step does, costs no page faults."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MIB = 20  # of a block; four of them are more than glibc keeps by itself
PROGRAM = f"""
import groundwork.host.early
import ctypes, resource

libc = ctypes.CDLL(None)
libc.prctl(41, 1, 0, 0, 0)  # PR_SET_THP_DISABLE: with huge pages there would be few faults anyway
libc.malloc.restype, libc.malloc.argtypes, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_size_t], [ctypes.c_void_p]

def step():
    blocks = [libc.malloc({MIB} << 20) for _ in range(4)]
    for block in blocks:
        ctypes.memset(block, 1, {MIB} << 20)
    for block in blocks:
        libc.free(block)

for _ in range(3):
    step()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(5):
    step()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def _faults(**environment: str) -> int:
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "GLIBC_"))}
    command = [sys.executable, "-c", PROGRAM]
    return int(subprocess.check_output(command, cwd=ROOT, env=inherited | environment, text=True))


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc gives freed memory back")
def test_freed_memory_is_kept():
    pages = 5 * 4 * (MIB << 20) // os.sysconf("SC_PAGE_SIZE")
    assert _faults() < pages / 10
    assert _faults(MALLOC_TRIM_THRESHOLD_="1") > pages / 2  # the user's own limit stands
