"""Checks of inputs that the operators cannot make: other types than tensors, and values that are not finite."""

from collections.abc import Mapping

import torch
from torch import Tensor


def check_tensors(inputs: Mapping[str, object]) -> None:
    """Raises TypeError that names the first input that is neither a tensor nor None."""
    for name, values in inputs.items():
        if values is not None and not isinstance(values, Tensor):
            kind = type(values)
            found = kind.__name__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__name__}"
            raise TypeError(f"{name} must be a tensor, got {found}: convert it with torch.as_tensor")


def whole_number(name: str, value: object, least: int = 1) -> int:
    """The number that `value` is, or that a tensor of one value holds. Raises ValueError for others than whole ones."""
    number = value.item() if isinstance(value, Tensor) and value.numel() == 1 else value
    if isinstance(value, Tensor) and isinstance(number, float) and number.is_integer():
        number = int(number)
    if not hasattr(number, "__index__") or isinstance(number, Tensor) or number < least:
        raise ValueError(f"{name} must be a whole number of {least} or more, got {value!r:.80}")
    return int(number)


def check_flag(name: str, value: object) -> None:
    """Raises TypeError for a value that is not True, False, 1, 0, None, or a tensor of one value."""
    if value is not None and (value.numel() != 1 if isinstance(value, Tensor) else value not in (False, True)):
        raise TypeError(f"{name} must be True or False, got {value!r:.80}")


def check_finite(what: str, values: Tensor) -> None:
    """Raises FloatingPointError with the number of values that are NaN or infinite, and the place of the first."""
    bad = ~torch.isfinite(values)
    if bad.any():
        raise FloatingPointError(
            f"{what} has {int(bad.sum())} values that are not finite, the first at {bad.nonzero()[0].tolist()}"
        )
