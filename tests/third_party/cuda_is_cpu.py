"""Run a script that says "cuda" everywhere on a machine without a GPU: python cuda_is_cpu.py SCRIPT [ARGUMENT ...]

Without a GPU, "cuda" means the CPU in the script's process. With a GPU, the script runs as it is.
"""

import os
import runpy
import sys
from collections.abc import Callable
from typing import Any

import torch
from torch.overrides import TorchFunctionMode

CPU = torch.device("cpu")


def _mapped(value: Any) -> Any:
    """The CPU for a name or an object that means a GPU; anything else unchanged."""
    if isinstance(value, torch.device):
        return CPU if value.type == "cuda" else value
    return CPU if isinstance(value, str) and value.split(":")[0] == "cuda" else value


class CudaIsCpu(TorchFunctionMode):
    """Replaces every GPU in the arguments of torch's functions, and lets `Tensor.cuda()` return the tensor itself."""

    def __torch_function__(self, func: Callable, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        if func is torch.Tensor.cuda:
            return args[0]
        kwargs = {name: _mapped(value) for name, value in (kwargs or {}).items()}
        return func(*map(_mapped, args), **kwargs)


def main() -> None:
    """Run the script of the command line as Python itself would."""
    del sys.argv[0]
    sys.path[0] = os.path.dirname(os.path.abspath(sys.argv[0]))
    if not torch.cuda.is_available():
        CudaIsCpu().__enter__()
    runpy.run_path(sys.argv[0], run_name="__main__")


if __name__ == "__main__":
    main()
