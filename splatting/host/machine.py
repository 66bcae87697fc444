"""Description of the machine of a measurement: processor, GPU, instruction set, commit."""

import os
import platform
import subprocess
from pathlib import Path

import torch


def cpu_name() -> str:
    """Name of the processor, from the kernel if it tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def device_name(device: torch.device) -> str:
    """The name of the GPU or of the processor that `device` stands for."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else cpu_name()


def instruction_set() -> str:
    """Instruction set that the CPU backends use here; the environment variable GS_ISA narrows it."""
    if platform.machine() in ("aarch64", "arm64", "ARM64"):
        return "baseline" if os.environ.get("GS_ISA") == "baseline" else "neon"
    capability = {"AVX512": "avx512", "AVX2": "avx2"}.get(torch.backends.cpu.get_cpu_capability(), "baseline")
    order = ["baseline", "avx2", "avx512"]
    wanted = os.environ.get("GS_ISA", capability)
    return min(capability, wanted, key=order.index) if wanted in order else capability


def gpu_name() -> str:
    """Name of the current GPU, with driver and clocks from nvidia-smi."""
    fields = "driver_version,clocks.sm,clocks.mem"
    index = f"--id={torch.cuda.current_device()}"
    state = _output("nvidia-smi", index, f"--query-gpu={fields}", "--format=csv,noheader")
    return f"{torch.cuda.get_device_name()} (driver, SM and memory clock: {state or 'not known'})"


def commit() -> str:
    """GS_COMMIT if set (for a copy without git), else the checkout's short hash, with + if files differ."""
    if os.environ.get("GS_COMMIT"):
        return os.environ["GS_COMMIT"]
    short = _output("git", "rev-parse", "--short", "HEAD")
    changed = _output("git", "status", "--porcelain", "--untracked-files=no")
    return (short + ("+" if changed else "")) or "not known (GS_COMMIT is not set)"


def _output(*command: str) -> str:
    """Output of a program; empty if it is missing or fails."""
    try:
        done = subprocess.run(command, cwd=Path(__file__).resolve().parent, capture_output=True, text=True)
    except OSError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""
