"""Device and description of the machine, for the head of a table, and printing of tables."""

import argparse
import importlib.util
import platform

import torch

from splatting.files.markdown_table import markdown_table
from splatting.host.machine import commit, cpu_name, gpu_name, instruction_set
from utils.system_utils import UserError, compute_device


def describe(device: torch.device | str = "cpu") -> str:
    """Return one line with processor or GPU, threads, instruction set, versions and commit."""
    python = f"Python {platform.python_version()}, torch {torch.__version__}"
    if torch.device(device).type == "cuda":
        python += f", CUDA {torch.version.cuda}"
        return f"{gpu_name()}, {cpu_name()}, {python}, commit {commit()}"
    return f"{cpu_name()}, {torch.get_num_threads()} threads, {instruction_set()}, {python}, commit {commit()}"


def print_table(header: list[str], rows: list[list[str]]) -> None:
    """Print a Markdown table with every column aligned to the left."""
    print(markdown_table(header, rows, right=False).rstrip("\n"), flush=True)


def add_device(parser: argparse.ArgumentParser) -> None:
    """Add --device, which `chosen_device` reads."""
    parser.add_argument("--device", choices=["cpu", "cuda"], help="default: cuda if there is a GPU and CUDA kernels")


def chosen_device(args: argparse.Namespace) -> str:
    """Return "cpu" or "cuda"; UserError if a GPU is asked for and none can be used."""
    found = compute_device().type
    if args.device == "cuda" and found != "cuda":
        raise UserError("--device cuda needs a visible GPU and the rasterizer built with CUDA (GS_CUDA=1)")
    return args.device or found


def require_matplotlib() -> None:
    """Raise UserError if matplotlib is missing."""
    if importlib.util.find_spec("matplotlib") is None:
        raise UserError("drawing needs matplotlib: pip install matplotlib, or draw on another machine")
