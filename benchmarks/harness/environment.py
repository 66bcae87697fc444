"""Description of the machine for the head of a table, and printing of tables."""

import platform

import torch

from utils.files.markdown_table import markdown_table
from utils.host.machine import commit, cpu_name, gpu_name, instruction_set


def describe(device: torch.device | str = "cpu") -> str:
    """Return one line with processor or GPU, threads, instruction set, versions and commit."""
    python = f"Python {platform.python_version()}, torch {torch.__version__}"
    if torch.device(device).type == "cuda":
        python += f", CUDA {torch.version.cuda}"
        return f"{gpu_name()}, {cpu_name()}, {python}, commit {commit()}"
    return f"{cpu_name()}, {torch.get_num_threads()} threads, {instruction_set()}, {python}, commit {commit()}"


def table(header: list[str], rows: list[list[str]]) -> list[str]:
    """Return the lines of a Markdown table with every column aligned to the left."""
    return markdown_table(header, rows, right=False).splitlines()


def print_table(header: list[str], rows: list[list[str]]) -> None:
    """Print the lines of `table`."""
    print("\n".join(table(header, rows)))
