"""A process that runs the cases whose kinds and numbers it reads, under a limit of memory.

python -m fuzz.worker SEED FOLDER
"""

import json
import math
import os
import pkgutil
import random
import resource
import sys
import time
import traceback
from pathlib import Path

import groundwork.host.openmp  # noqa: F401  isort: skip  (before torch)
import torch

import train
from fuzz import KINDS
from utils.system_utils import UserError

MOST = 2 << 30  # bytes that a case may add to the memory in use
ROOM = 3 << 30  # that it can address: more than it may, so that an excess shows


def main() -> None:
    """Answer every line of stdin with a line of JSON: a finding or null, the bytes added, the processor's seconds."""
    seed, folder = sys.argv[1], Path(sys.argv[2])
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what is said goes to the log
    train.summary_writer = lambda folder: None  # its threads would pile up
    torch.set_num_threads(1)
    kinds = {}
    for kind, place in KINDS.items():
        (folder / kind).mkdir()
        kinds[kind] = pkgutil.resolve_name(f"fuzz.{place}")(folder / kind)
    size = _memory("VmSize") + ROOM
    resource.setrlimit(resource.RLIMIT_AS, (size, size))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    print("ready", file=answers, flush=True)
    for line in sys.stdin:
        kind, number = line.split()
        os.truncate(2, 0)
        answer = _run(kinds[kind], random.Random(f"{seed} {kind} {number}"))
        sys.stdout.flush()
        print(json.dumps(answer), file=answers, flush=True)


def _run(kind: object, rng: random.Random) -> tuple[str | None, int, float]:
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    before, begin = _memory("VmRSS"), time.process_time()
    finding = _finding(kind, rng)
    more, seconds = max(_memory("VmHWM") - before, 0), time.process_time() - begin
    if more > getattr(kind, "most", MOST):
        finding = finding or f"took {more >> 20} MiB"
    if seconds > getattr(kind, "seconds", math.inf):
        finding = finding or f"took {seconds:.1f} s"
    return finding, more, seconds


def _finding(kind: object, rng: random.Random) -> str | None:
    try:
        kind.run(rng)
    except UserError as error:
        if "\n" in str(error):
            return f"a message of several lines: {error}"
    except SystemExit as error:  # of argparse
        if error.code not in (0, 2):
            return f"exit status {error.code}"
    except BaseException:
        return traceback.format_exc()[-3000:]
    return None


def _memory(name: str) -> int:
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(f"{name}:"))
    return int(line.split()[1]) << 10


if __name__ == "__main__":
    main()
