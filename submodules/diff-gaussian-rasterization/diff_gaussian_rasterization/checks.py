"""Checks of the rasterizer's inputs, whose messages name the input, what was wanted and what was given."""

import torch
from torch import Tensor

from diff_gaussian_rasterization.gaussians import Gaussians

# A Gaussian's values in each input; a row of sh_rest depends on the number of bands.
ROWS = {"means": (3,), "means2d": (3,), "opacities": (1,), "scales": (3,), "rotations": (4,), "cov3d": (6,)}
ROWS |= {"colors": (3,), "sh_dc": (1, 3)}
_CHECKED = [(name, ROWS.get(name)) for name in (*Gaussians._fields, "means2d")]


def check_inputs(gaussians: Gaussians, means2d: Tensor, sh_degree: int, raw: bool) -> None:
    """Raises TypeError for a dtype or device that does not fit, ValueError for a shape, an alternative or a degree."""
    means = gaussians.means
    if means.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"means must be float32 or float64, got {means.dtype}")
    if means.dim() != 2 or means.shape[1] != 3:
        raise ValueError(f"means must be (N, 3), got {tuple(means.shape)}")
    if (gaussians.cov3d is None) == (gaussians.scales is None or gaussians.rotations is None):
        raise ValueError("give scales and rotations, or cov3d")
    if (gaussians.colors is None) == (gaussians.sh_dc is None or gaussians.sh_rest is None):
        raise ValueError("give sh_dc and sh_rest, or colors")
    dtype, device, count = means.dtype, means.device, means.shape[0]
    for (name, row), values in zip(_CHECKED, (*gaussians, means2d), strict=True):
        if values is None:
            continue
        if values.dtype is not dtype or values.device != device:
            raise TypeError(f"{name} must be {dtype} on {device} like means, got {values.dtype} on {values.device}")
        shape = values.shape
        wanted = (count, *(row or shape[1:]))
        if shape != wanted and not (name == "opacities" and shape == (count,)):
            raise ValueError(f"{name} must be {wanted}{_hint(name, raw)}, got {tuple(shape)}")
    if not 0 <= sh_degree <= 3:
        raise ValueError(f"sh_degree must be 0 to 3, got {sh_degree}")
    if gaussians.sh_rest is not None:
        _check_bands(gaussians.sh_rest, sh_degree)


def check_finite(what: str, values: Tensor) -> None:
    """Raises FloatingPointError with the number of values that are NaN or infinite, and the place of the first."""
    bad = ~torch.isfinite(values)
    if bad.any():
        raise FloatingPointError(
            f"{what} has {int(bad.sum())} values that are not finite, the first at {bad.nonzero()[0].tolist()}"
        )


def _hint(name: str, raw: bool) -> str:
    """Tells callers who mistook the activation what is wanted."""
    if name != "scales":
        return ""
    return " (logarithms of the scales)" if raw else " (activated scales, one per axis)"


def _check_bands(sh_rest: Tensor, sh_degree: int) -> None:
    needed = (sh_degree + 1) ** 2 - 1
    if sh_rest.dim() != 3 or sh_rest.shape[2] != 3 or sh_rest.shape[1] < needed:
        raise ValueError(
            f"sh_rest must be ({sh_rest.shape[0]}, {needed} or more, 3) for sh_degree {sh_degree}, "
            f"got {tuple(sh_rest.shape)}"
        )
