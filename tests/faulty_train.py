"""train.py with a fault in one rank, for tests of several: `faulty_train.py FAULT RANK ITERATION OPTIONS...`.

FAULT is one of `_FAULTS`, which come in that iteration; or code (other files, in the folder that OTHER_CODE names),
warning, none. With whole- before it, each rank trains the whole model, with later- until iteration 100. A restarted
training has no fault. All ranks print the same lines at first.
"""

import math
import os
import sys

fault, rank, iteration, options = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4:]
mine = os.environ["RANK"] == str(rank) and os.environ["TORCHELASTIC_RESTART_COUNT"] == "0"
if mine and fault == "code":
    sys.path.insert(0, os.environ["OTHER_CODE"])

# ruff: noqa: E402
import splatting.host.early  # noqa: F401  isort: skip  (as train.py begins)
import signal
import time
from collections.abc import Callable

import torch

import splatting.distributed.watchdog
import train
from splatting.training import division
from splatting.training import run as runs
from splatting.training.iteration import Iteration
from splatting.training.run import Run
from utils.system_utils import run_cli

splatting.distributed.watchdog.PATIENCE = 3.0
kind, _, fault = fault.rpartition("-")
division.PAYS = dict.fromkeys(division.PAYS, math.inf if kind else 0.0)
if kind == "later":
    division.Division.pays = lambda self, at: at.iteration >= 100
if kind and fault != "none":
    runs.REST = 4  # ranks agree as often
prepare = Run.prepare
beat = splatting.distributed.watchdog.Watch.beat


def _long_beat(watch: splatting.distributed.watchdog.Watch) -> None:
    """As with a slow store. A process that ends while its watch asks the store aborts."""
    beat(watch)
    until = time.monotonic() + 0.5
    while watch.is_alive() and time.monotonic() < until:
        watch._store.read("here")


def _raise(error: Exception) -> Callable[[Run], None]:
    def fail(run: Run) -> None:
        raise error

    return fail


def _hang(run: Run) -> None:
    while True:
        signal.pause()


def _overflow(run: Run) -> None:
    """Make a gradient of the next step infinite."""
    optimizer = run.gaussians.optimizer
    usual = optimizer.step

    def step(*args: object) -> object:
        optimizer.param_groups[0]["params"][0].grad[3, 0] = torch.inf
        optimizer.step = usual
        return usual(*args)

    optimizer.step = step


_FAULTS = {
    "kill": lambda run: os.kill(os.getpid(), signal.SIGKILL),
    "interrupt": lambda run: os.kill(os.getpid(), signal.SIGINT),
    "memory": _raise(MemoryError()),
    "bug": _raise(ValueError("no such thing")),
    "hang": _hang,
    "overflow": _overflow,
}


def _prepare(run: Run, step: Iteration) -> None:
    prepare(run, step)
    if mine and step.iteration == iteration and fault in _FAULTS:
        _FAULTS[fault](run)


def _main() -> None:
    print("printed by every rank")
    print("warning: of every rank", file=sys.stderr)
    if mine and fault == "warning":
        print("warning: of one rank alone", file=sys.stderr)
    train.main(options)


Run.prepare = _prepare
splatting.distributed.watchdog.Watch.beat = _long_beat
if __name__ == "__main__":
    run_cli(_main, several=True)
