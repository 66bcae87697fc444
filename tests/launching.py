"""Starts of train.py by torchrun, on the CPU, with the outputs of each rank in files."""

import os
import sys
import threading
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import torch.distributed.run as torchrun
from torch.distributed.elastic.multiprocessing.api import PContext
from torch.distributed.elastic.multiprocessing.errors import ChildFailedError

ROOT = Path(__file__).resolve().parents[1]
OPTIONS = ("--iterations", "12", "--checkpoint_iterations", "5", "--save_iterations", "6", "-r", "2")


class Launched(NamedTuple):
    """The end of a training of several ranks.

    stdout, stderr: outputs of all ranks and restarts, by rank.
    """

    status: int
    stdout: list[str]
    stderr: list[str]

    @property
    def errors(self) -> list[str]:
        """Lines of error that our ranks have printed."""
        return [line for text in self.stderr for line in text.splitlines() if line.startswith("error:")]


def command(logs: Path, size: int, fault: str, *options: str, restarts: int = 0) -> list[str]:
    """The command line. fault: the first arguments of faulty_train.py."""
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc_per_node={size}"]
    torchrun += [f"--max-restarts={restarts}", f"--log-dir={logs}", "--redirects=3"]
    return [*torchrun, str(ROOT / "tests" / "faulty_train.py"), *fault.split(), *options]


def words(scene: Path, out: Path, *options: str) -> list[str]:
    """Options of a short training."""
    return ["-s", str(scene), "-m", str(out), *OPTIONS, *options]


def environment(**more: str) -> dict[str, str]:
    """The environment, in which ranks find the code of this checkout."""
    return {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"} | {
        "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]),
        "GLOO_SOCKET_IFNAME": "lo",
        **more,
    }


def outputs(logs: Path, size: int, status: int) -> Launched:
    """Read the logs."""

    def of(name: str) -> list[str]:
        found = [sorted(logs.glob(f"*/attempt_*/{rank}/{name}.log")) for rank in range(size)]
        return ["".join(path.read_text().replace("\r", "\n") for path in paths) for paths in found]

    return Launched(status, of("stdout"), of("stderr"))


def launch(logs: Path, fault: str, *options: str, size: int = 2, restarts: int = 0, **more: str) -> Launched:
    """Train until it ends, at most two minutes.

    torchrun is a thread of this process, which has imported torch: that takes as long as the rest of a short training.
    """
    line = command(logs, size, fault, *options, restarts=restarts)[3:]
    folder, statuses = Path.cwd(), []

    def run() -> None:
        try:
            torchrun.main(line)
        except ChildFailedError:
            statuses.append(1)
        else:
            statuses.append(0)

    thread = threading.Thread(target=run, daemon=True)
    patience = mock.patch.object(PContext.close, "__defaults__", (None, 3))  # seconds, else 30
    with patience, mock.patch.dict(os.environ, environment(**more), clear=True):
        os.chdir(logs.parent)
        try:
            thread.start()
            thread.join(120)
        finally:
            os.chdir(folder)
    assert statuses, "torchrun did not end"
    return outputs(logs, size, statuses[0])


def launch_fault(scene: Path, folder: Path, fault: str, *options: str, **more: Any) -> Launched:
    """Train into folder/out with a fault."""
    return launch(folder / "logs", fault, *words(scene, folder / "out", "--no_curve", "--plain_step", *options), **more)
