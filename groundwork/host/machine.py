"""This machine and this code: the device that computes, processors, names and the commit for reports.

torch is imported on first use: not every program needs it. Run as a module, it prints `facts` as JSON.
"""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import groundwork.host.openmp  # noqa: F401  (for programs that imported torch before)
from groundwork.host import torchrun
from groundwork.host.programs import find_program

if TYPE_CHECKING:
    import torch

_ROOT = Path(__file__).resolve().parents[2]
_VERSION = _ROOT / "version.txt"  # the one place where the version is written by hand
VERSION = _VERSION.read_text(encoding="utf-8").strip() if _VERSION.is_file() else "unknown"  # only the code was copied
MOST_THREADS = 16  # for work on image files: more threads only wait for memory and disk
OLDEST_GPU = (7, 5)  # compute capability, as in submodules/common/build_extension.py
_PACKAGES = ("lpips", "numpy", "pillow", "pycolmap", "torch", "torchvision")
_CGROUPS = Path("/sys/fs/cgroup")
_OWN_CGROUPS = Path("/proc/self/cgroup")


def compute_device() -> torch.device:
    """`cuda` when a GPU is visible and the rasterizer was built with its CUDA kernels, else `cpu`."""
    import torch

    return torch.device("cuda" if torch.cuda.is_available() and _has_cuda_kernels() else "cpu")


def missing_code_message(error: BaseException) -> str:
    """A message if the error means that torch or an extension has no code for the current GPU; else empty."""
    if "no kernel image is available" not in str(error):
        return ""
    import torch

    major, minor = torch.cuda.get_device_capability()
    gpu = f"{torch.cuda.get_device_name()} has compute capability {major}.{minor}"
    if (major, minor) < OLDEST_GPU:
        oldest = ".".join(map(str, OLDEST_GPU))
        return f"{gpu}, but {oldest} is the oldest that works: set CUDA_VISIBLE_DEVICES= to use the CPU"
    return f"{gpu}, for which torch or this build has no code: run `pip install --force-reinstall .`"


def _has_cuda_kernels() -> bool:
    """Tell whether the rasterizer was built with CUDA kernels; False without the rasterizer."""
    try:
        from diff_gaussian_rasterization import has_cuda_kernels
    except ImportError:  # metrics.py and doctor.py work without the extension
        return False
    return has_cuda_kernels()


def cores() -> int:
    """Number of processors allowed by affinity (taskset, Slurm) and by the process's cgroups (Docker's --cpus).

    Processes that train together on this host share them evenly.
    """
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, math.ceil(min(count, _read_quota())) // torchrun.local_size())


def threads(most: int = MOST_THREADS) -> int:
    """Number of threads for work that releases Python's lock: one for each of `cores`, `most` at most."""
    return min(cores(), most)


def _read_quota() -> float:
    """Number of processors that the cgroup and its parents allow (cpu.max of version 2); infinite without a limit."""
    try:
        own = next(line[3:] for line in _OWN_CGROUPS.read_text().splitlines() if line.startswith("0::"))
    except (OSError, StopIteration):
        return math.inf
    folder = _CGROUPS / own.lstrip("/")
    found = math.inf
    for group in (folder, *folder.parents):
        if not group.is_relative_to(_CGROUPS):
            break
        try:
            quota, period = (group / "cpu.max").read_text().split()
            found = min(found, int(quota) / int(period))
        except (OSError, ValueError):  # the root has none; "max" is no limit
            continue
    return found


def cpu_name() -> str:
    """Name of the processor, from the kernel if it tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def device_name(device: torch.device) -> str:
    """The name of the GPU or of the processor that `device` stands for."""
    import torch

    return torch.cuda.get_device_name(device) if device.type == "cuda" else cpu_name()


def instruction_set() -> str:
    """Instruction set that the CPU backends use here; the environment variable GS_ISA narrows it."""
    import torch

    if platform.machine() in ("aarch64", "arm64", "ARM64"):
        return "baseline" if os.environ.get("GS_ISA") == "baseline" else "neon"
    capability = {"AVX512": "avx512", "AVX2": "avx2"}.get(torch.backends.cpu.get_cpu_capability(), "baseline")
    order = ["baseline", "avx2", "avx512"]
    requested = os.environ.get("GS_ISA", capability)
    return min(capability, requested, key=order.index) if requested in order else capability


def gpu_name() -> str:
    """Name of the current GPU, with driver and clocks from nvidia-smi."""
    import torch

    fields = "driver_version,clocks.sm,clocks.mem"
    index = f"--id={torch.cuda.current_device()}"
    state = _run_program("nvidia-smi", index, f"--query-gpu={fields}", "--format=csv,noheader")
    return f"{torch.cuda.get_device_name()} (driver, SM and memory clock: {state or 'not known'})"


def commit() -> str:
    """GS_COMMIT if set (for a copy without git), else the checkout's short hash, with + if files differ."""
    if os.environ.get("GS_COMMIT"):
        return os.environ["GS_COMMIT"]
    short = _run_program("git", "rev-parse", "--short", "HEAD")
    changed = _run_program("git", "status", "--porcelain", "--untracked-files=no")
    return (short + ("+" if changed else "")) or "not known (GS_COMMIT is not set)"


def _run_program(*command: str) -> str:
    """Output of a program; empty if it is missing or fails."""
    try:
        program = find_program(command[0]) or "/"  # which cannot be run
        done = subprocess.run([program, *command[1:]], cwd=_ROOT, capture_output=True, text=True)
    except OSError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def facts(device: torch.device | str) -> dict[str, Any]:
    """Processor, threads, versions and commit of this machine and checkout; its GPU, too, if `device` is one."""
    from importlib.metadata import distributions  # takes a while to import

    import torch

    device = torch.device(device).type
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


def facts_from_process() -> dict[str, Any]:
    """`facts` of the device that computes; {} if that fails.

    A separate process asks, because asking a GPU for its name occupies GPU memory until the process ends.
    """
    command = [sys.executable, "-m", "groundwork.host.machine"]
    done = subprocess.run(command, cwd=_ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        print(f"warning: cannot describe this machine:\n{done.stderr}", file=sys.stderr)
        return {}
    return json.loads(done.stdout)


def one_line(facts: dict[str, Any]) -> str:
    """Summarise `facts` in one line."""
    if not facts:
        return "not known"
    where = f"{facts['gpu']}, {facts['cpu']}" if facts["gpu"] else f"{facts['cpu']}, {facts['instruction_set']}"
    return (
        f"{where}, {facts['threads']} threads, Python {facts['python']}, torch {facts['packages']['torch']}, "
        f"commit {facts['commit']}"
    )


if __name__ == "__main__":
    print(json.dumps(facts(compute_device()), sort_keys=True, allow_nan=False))
