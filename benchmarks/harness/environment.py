"""What a table of measurements has to say about where it was made."""

import platform

import torch

from utils.files.markdown_table import markdown_table
from utils.host.machine import commit, cpu_name, gpu_name, instruction_set


def describe(device: torch.device | str = "cpu") -> str:
    """One line: processor or GPU, threads, instruction set, versions, commit."""
    python = f"Python {platform.python_version()}, torch {torch.__version__}"
    if torch.device(device).type == "cuda":
        python += f", CUDA {torch.version.cuda}"
        return f"{gpu_name()}, {cpu_name()}, {python}, commit {commit()}"
    return f"{cpu_name()}, {torch.get_num_threads()} threads, {instruction_set()}, {python}, commit {commit()}"


def table(header: list[str], rows: list[list[str]]) -> list[str]:
    """The lines of a Markdown table, every column to the left."""
    return markdown_table(header, rows, right=False).splitlines()


def print_table(header: list[str], rows: list[list[str]]) -> None:
    """Print what `table` gives."""
    print("\n".join(table(header, rows)))
