"""The inputs of a set of Gaussians, listed once: `rasterize`, `decisive` and the oracle take these names."""

import inspect
from collections.abc import Callable
from typing import NamedTuple, TypeVar

from torch import Tensor

_Function = TypeVar("_Function", bound=Callable)


class Gaussians(NamedTuple):
    """N Gaussians, in the order of the operators' arguments.

    Give scales and rotations, or cov3d; and sh_dc and sh_rest, or colors. "Raw" values are the optimised ones, to which
    the activations have not been applied.
    """

    means: Tensor  # (N, 3) world
    opacities: Tensor  # (N, 1) or (N,): in [0, 1]; raw: logits
    scales: Tensor | None = None  # (N, 3) world units, positive; raw: logarithms
    rotations: Tensor | None = None  # (N, 4) w x y z, used as they are; raw: any length, zero means the identity
    cov3d: Tensor | None = None  # (N, 6) covariances: xx xy xz yy yz zz
    colors: Tensor | None = None  # (N, 3)
    sh_dc: Tensor | None = None  # (N, 1, 3) spherical harmonics of degree 0
    sh_rest: Tensor | None = None  # (N, K - 1, 3) those of higher degrees; bands above the active degree are not read


def lists_gaussians(function: _Function) -> _Function:
    """Lets help() and inspect.signature list the optional fields of `Gaussians` in place of `**others`."""
    fields = [
        inspect.Parameter(
            name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Gaussians.__annotations__[name]
        )
        for name, default in Gaussians._field_defaults.items()
    ]
    signature = inspect.signature(function)
    named = [p for p in signature.parameters.values() if p.kind is not inspect.Parameter.VAR_KEYWORD]
    function.__signature__ = signature.replace(parameters=[*named, *fields])
    return function
