"""Loads the compiled operators of the package that has this module, as functions that raise the errors they mean.

torch's stable interface makes a RuntimeError of every error of a compiled operator. The message of another error begins
with its type.
"""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

_PACKAGE = __name__.partition(".")[0]
_BUILD = f"run `pip install ./submodules/{_PACKAGE.replace('_', '-')}` in the repository"
try:
    import torch
except ModuleNotFoundError as error:
    if error.name != "torch":
        raise
    raise ImportError(f"{_PACKAGE} needs torch: install it, then {_BUILD}") from error

_TYPES = {"TypeError": TypeError, "ValueError": ValueError, "OutOfMemoryError": torch.OutOfMemoryError}


def _load_operators() -> SimpleNamespace:
    """Return a function for each operator; its attribute `default` is the operator."""
    library = Path(__file__).with_name("_backend.so")
    try:
        torch.ops.load_library(library)
    except OSError as error:
        what = f"does not fit torch {torch.__version__}" if library.exists() else "is not built"
        raise ImportError(f"{_PACKAGE} {what}: {_BUILD}") from error
    names = [name.split("::") for name in torch._C._dispatch_get_all_op_names() if name.startswith(f"{_PACKAGE}::")]
    return SimpleNamespace(**{name: _retype_errors(getattr(getattr(torch.ops, _PACKAGE), name)) for _, name in names})


def _retype_errors(packet: Any) -> Callable[..., Any]:
    """Return a function that calls an operator and raises the error that its message names.

    packet: operator, as torch.ops has it.
    """

    def call(*arguments: Any, **named: Any) -> Any:
        try:
            return packet(*arguments, **named)
        except RuntimeError as error:
            kind, _, message = str(error).partition(": ")
            if kind not in _TYPES:
                raise
            raise _TYPES[kind](message) from None

    call.default = packet.default
    return call


@cache  # the query takes longer than the checks of a call
def has_kernels(operator: str, device: str) -> bool:
    """Tell whether this build has an operator for a type of devices, "cpu" or "cuda"."""
    return torch._C._dispatch_has_kernel_for_dispatch_key(f"{_PACKAGE}::{operator}", device.upper())


OPERATORS = _load_operators()
