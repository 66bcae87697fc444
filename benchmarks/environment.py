"""What a table of measurements has to say about where it was made."""

import os
import platform
import subprocess
from pathlib import Path

import torch

from utils.machine import cpu_name


def instruction_set() -> str:
    """The instruction set that the CPU backends use here (environment variable GS_ISA narrows it)."""
    capability = {"AVX512": "avx512", "AVX2": "avx2"}.get(torch.backends.cpu.get_cpu_capability(), "baseline")
    order = ["baseline", "avx2", "avx512"]
    wanted = os.environ.get("GS_ISA", capability)
    return min(capability, wanted, key=order.index) if wanted in order else capability


def gpu_name() -> str:
    """The current GPU's name with driver and clocks as nvidia-smi gives them."""
    fields = "driver_version,clocks.sm,clocks.mem"
    index = f"--id={torch.cuda.current_device()}"
    state = _output("nvidia-smi", index, f"--query-gpu={fields}", "--format=csv,noheader")
    return f"{torch.cuda.get_device_name()} (driver, SM and memory clock: {state or 'not known'})"


def commit() -> str:
    """GS_COMMIT where it is set (a copy without git), else the checkout's short hash, with + where files differ."""
    if os.environ.get("GS_COMMIT"):
        return os.environ["GS_COMMIT"]
    short = _output("git", "rev-parse", "--short", "HEAD")
    changed = _output("git", "status", "--porcelain", "--untracked-files=no")
    return (short + ("+" if changed else "")) or "not known (GS_COMMIT is not set)"


def _output(*command: str) -> str:
    """What a program prints; empty where it is missing or fails."""
    try:
        done = subprocess.run(command, cwd=Path(__file__).resolve().parent, capture_output=True, text=True)
    except OSError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def describe(device: torch.device | str = "cpu") -> str:
    """One line: processor or GPU, threads, instruction set, versions, commit."""
    python = f"Python {platform.python_version()}, torch {torch.__version__}"
    if torch.device(device).type == "cuda":
        python += f", CUDA {torch.version.cuda}"
        return f"{gpu_name()}, {cpu_name()}, {python}, commit {commit()}"
    return f"{cpu_name()}, {torch.get_num_threads()} threads, {instruction_set()}, {python}, commit {commit()}"


def table(header: list[str], rows: list[list[str]]) -> list[str]:
    """The lines of a Markdown table, padded so that it reads well in a terminal too."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    return [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |"
        for row in [header, ["-" * width for width in widths], *rows]
    ]


def print_table(header: list[str], rows: list[list[str]]) -> None:
    """Print what `table` gives."""
    print("\n".join(table(header, rows)))
