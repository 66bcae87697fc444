"""The check of `settings.debug`; the operators themselves check shapes, dtypes and devices."""

import torch
from torch import Tensor


def check_finite(what: str, values: Tensor) -> None:
    """Raises FloatingPointError with the number of values that are NaN or infinite, and the place of the first."""
    bad = ~torch.isfinite(values)
    if bad.any():
        raise FloatingPointError(
            f"{what} has {int(bad.sum())} values that are not finite, the first at {bad.nonzero()[0].tolist()}"
        )
