"""Per-Gaussian parameters, in one table that the optimiser, density control, PLY and checkpoints iterate over."""

import argparse
import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

from torch import Tensor

Rows = dict[str, Tensor]  # raw values (N, *shape), float32, by optimiser group
INITIAL_OPACITY = 0.1
_INITIAL_LOGIT = math.log(INITIAL_OPACITY / (1.0 - INITIAL_OPACITY))


class Attribute(NamedTuple):
    """One raw (unactivated) parameter of every Gaussian."""

    field: str  # name of the model's tensor
    shape: tuple[int, ...]  # of one Gaussian's values, (..., 3) with RGB last for SH
    columns: list[str]  # in the PLY; SH band by band within a channel
    rate: Callable[[argparse.Namespace, float], float]  # learning rate from optimisation options and scene extent
    start: float = 0.0  # every raw value of a new Gaussian, unless its point tells (scene/gaussians/start.py)


@cache
def attributes(sh_degree: int, further: bool = True) -> dict[str, Attribute]:
    """Attributes by optimiser group, in the order of groups and PLY columns, for a maximal SH degree.

    The six of the paper come first. A further attribute is one more line here. Callers share the table. further: False:
    the six, which are all that files of other tools have.
    """
    bands = (sh_degree + 1) ** 2 - 1
    table = {
        "xyz": Attribute("_xyz", (3,), ["x", "y", "z"], lambda opt, extent: opt.position_lr_init * extent),
        "f_dc": Attribute("_features_dc", (1, 3), _number_names("f_dc", 3), lambda opt, _: opt.feature_lr),
        "f_rest": Attribute(
            "_features_rest", (bands, 3), _number_names("f_rest", 3 * bands), lambda opt, _: opt.feature_lr / 20.0
        ),
        "opacity": Attribute("_opacity", (1,), ["opacity"], lambda opt, _: opt.opacity_lr, _INITIAL_LOGIT),
        "scaling": Attribute("_scaling", (3,), _number_names("scale", 3), lambda opt, _: opt.scaling_lr),
        "rotation": Attribute("_rotation", (4,), _number_names("rot", 4), lambda opt, _: opt.rotation_lr),
    }
    return table if further else {name: table[name] for name in table if name in IN_CHECKPOINT}


# Entries 1 to 6 of a checkpoint, in the reference's order. Other attributes follow after its last entry.
IN_CHECKPOINT = ("xyz", "f_dc", "f_rest", "scaling", "rotation", "opacity")


def _number_names(name: str, count: int) -> list[str]:
    return [f"{name}_{i}" for i in range(count)]
