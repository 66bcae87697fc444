"""What a table of measurements has to say about where it was made."""

import os
import platform
import subprocess
from pathlib import Path

import torch


def cpu_name() -> str:
    """The processor's name, from the kernel where it tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def instruction_set() -> str:
    """The instruction set that the CPU backends use here (environment variable GS_ISA narrows it)."""
    capability = {"AVX512": "avx512", "AVX2": "avx2"}.get(torch.backends.cpu.get_cpu_capability(), "baseline")
    order = ["baseline", "avx2", "avx512"]
    wanted = os.environ.get("GS_ISA", capability)
    return min(capability, wanted, key=order.index) if wanted in order else capability


def commit() -> str:
    """Short hash of the checkout, with + where files differ from it."""
    root = Path(__file__).resolve().parent
    run = lambda *args: subprocess.run(["git", *args], cwd=root, capture_output=True, text=True).stdout.strip()  # noqa: E731
    return run("rev-parse", "--short", "HEAD") + ("+" if run("status", "--porcelain", "--untracked-files=no") else "")


def describe() -> str:
    """One line: processor, threads, instruction set, versions, commit."""
    return (
        f"{cpu_name()}, {torch.get_num_threads()} threads, {instruction_set()}, Python {platform.python_version()}, "
        f"torch {torch.__version__}, commit {commit()}"
    )


def print_table(header: list[str], rows: list[list[str]]) -> None:
    """A Markdown table, padded so that it reads well in a terminal too."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    for row in [header, ["-" * width for width in widths], *rows]:
        print("| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |")
