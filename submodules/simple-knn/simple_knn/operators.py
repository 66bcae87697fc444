"""The operators of a namespace as functions that raise the errors they mean.

torch's stable interface makes a RuntimeError of every error of a compiled operator. The message of another error begins
with its type.
"""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import torch

_TYPES = {"TypeError": TypeError, "ValueError": ValueError, "OutOfMemoryError": torch.OutOfMemoryError}


def operators(namespace: str) -> SimpleNamespace:
    """Return a function for each operator of a namespace of torch.ops; its attribute `default` is the operator."""
    names = [name for name in torch._C._dispatch_get_all_op_names() if name.startswith(f"{namespace}::")]
    packets = [getattr(getattr(torch.ops, namespace), name.partition("::")[2]) for name in names]
    return SimpleNamespace(**{packet.__name__: _raising(packet) for packet in packets})


def _raising(packet: Any) -> Callable[..., Any]:
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
