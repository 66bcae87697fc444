"""train.py with a fault in one rank, for tests of several: `faulty_train.py FAULT RANK ITERATION OPTIONS...`.

FAULT is one of `_FAULTS`, which come in that iteration; or code (other files, in the folder that OTHER_CODE names), or
none. A restarted training has no fault. All ranks print the same lines at first. Where one hangs, the others wait ten
seconds.
"""

import os
import sys

fault, rank, iteration, options = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4:]
mine = os.environ["RANK"] == str(rank) and os.environ["TORCHELASTIC_RESTART_COUNT"] == "0"
if mine and fault == "code":
    sys.path.insert(0, os.environ["OTHER_CODE"])

# ruff: noqa: E402
import groundwork.host.early  # noqa: F401  isort: skip  (as train.py begins)
import signal
from collections.abc import Callable
from datetime import timedelta

import torch

import train
from groundwork.ranks import launcher
from splatting.iteration import Iteration
from splatting.run import Run
from utils.system_utils import run_cli

launcher.TIMEOUT = timedelta(seconds=10 if fault == "hang" else 60)
prepare = Run.prepare


def _raise(error: Exception) -> Callable[[Run], None]:
    def fail(run: Run) -> None:
        raise error

    return fail


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
    "hang": lambda run: os.kill(os.getpid(), signal.SIGSTOP),
    "overflow": _overflow,
}


def _prepare(run: Run, step: Iteration) -> None:
    prepare(run, step)
    if mine and step.iteration == iteration and fault in _FAULTS:
        _FAULTS[fault](run)


def _main() -> None:
    print("printed by every rank")
    print("warning: of every rank", file=sys.stderr)
    train.main(options)


Run.prepare = _prepare
if __name__ == "__main__":
    run_cli(_main, several=True)
