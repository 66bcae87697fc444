"""Description of the machine and software that trained, which the module prints as JSON when it is run."""

from __future__ import annotations

import json
import platform
import subprocess
import sys
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

_ROOT = Path(__file__).resolve().parents[2]
_PACKAGES = ("lpips", "numpy", "pillow", "pycolmap", "torch", "torchvision")


def machine() -> dict[str, Any]:
    """Return processor, GPU, threads, versions and commit of this machine and checkout; {} if that fails.

    A separate process asks, because asking a GPU for its name occupies GPU memory until the process ends.
    """
    command = [sys.executable, "-m", "splatting.evaluation.machine"]
    done = subprocess.run(command, cwd=_ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        print(f"warning: cannot describe this machine:\n{done.stderr}", file=sys.stderr)
        return {}
    return json.loads(done.stdout)


def _describe() -> dict[str, Any]:
    import torch

    from splatting.host.machine import VERSION, commit, cpu_name, gpu_name, instruction_set
    from utils.system_utils import compute_device

    device = compute_device().type
    return {
        "commit": commit(),
        "cpu": cpu_name(),
        "cuda": torch.version.cuda if device == "cuda" else None,
        "device": device,
        "gpu": gpu_name() if device == "cuda" else None,
        "instruction_set": instruction_set(),
        "packages": {name: next((one.version for one in distributions(name=name)), None) for name in _PACKAGES},
        "python": platform.python_version(),
        "system": platform.platform(),
        "threads": torch.get_num_threads(),
        "version": VERSION,
    }


def one_line(facts: dict[str, Any]) -> str:
    """Summarise the result of `machine` in one line."""
    if not facts:
        return "not known"
    where = f"{facts['gpu']}, {facts['cpu']}" if facts["gpu"] else f"{facts['cpu']}, {facts['instruction_set']}"
    return (
        f"{where}, {facts['threads']} threads, Python {facts['python']}, torch {facts['packages']['torch']}, "
        f"commit {facts['commit']}"
    )


if __name__ == "__main__":
    import splatting.host.openmp  # noqa: F401  (before torch)

    print(json.dumps(_describe(), sort_keys=True, allow_nan=False))
