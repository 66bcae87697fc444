"""Places in the host's memory for tensors of a GPU, whose kernels read and write them over the bus."""

import splatting.host.extensions  # noqa: F401  isort: skip  (before the extensions)
from diff_gaussian_rasterization.backend import OPERATORS
from torch import Tensor


def in_host_memory(values: Tensor) -> Tensor:
    """A tensor of the same device in page-locked memory of the host; the same one if it lies there, or on the CPU."""
    if not values.numel() or OPERATORS.is_in_host_memory(values):
        return values
    return OPERATORS.in_host_memory(values)


def beside(old: Tensor, new: Tensor) -> Tensor:
    """Values that take the place of old ones: in the host's memory if those lie there, else the same tensor."""
    if not old.is_cuda or not old.numel() or not OPERATORS.is_in_host_memory(old):
        return new
    return in_host_memory(new.to(old.device))
