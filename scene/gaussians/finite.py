"""Check that the values of Gaussians are finite."""

import math
import sys

import torch
from torch import Tensor

from groundwork.ranks.rows import WHOLE, Shards
from scene.gaussians.attributes import Rows
from utils.system_utils import UserError

SMALLEST = -80.0  # exp(-80) is 1.8e-35, which float32 still holds with all its digits
_PART = 1 << 16  # rows checked at a time, as there may be little memory left


def check_finite(rows: Rows, where: str, remedy: str, shards: Shards = WHOLE) -> None:
    """Raise a UserError if a value of an attribute is not finite.

    The message names the attribute, the number of Gaussians with such values, and the first of these, counted from 0.

    where, remedy: parts of the message. shards: place of the rows among those of all processes, which raise the same.
    """
    for name, values in rows.items():
        finite = torch.cat([part.isfinite().flatten(1).all(dim=1) for part in values.split(_PART)])
        if shards.ranks.any_rank(not finite.all()):
            bad = shards.marked_indices(~finite)
            raise UserError(
                f"{name} of {len(bad)} of {shards.total(len(values))} Gaussians in {where} is not finite "
                f"(the first is Gaussian {int(bad[0])}); {remedy}"
            )


def with_scales(log_scales: Tensor) -> Tensor:
    """Raise logarithms of scales (N, 2 or 3) of 0 to SMALLEST: a scale of 0 is drawn as a tiny one."""
    zero = log_scales == -math.inf
    return log_scales.masked_fill(zero, SMALLEST) if zero.any() else log_scales


def warn_of_undrawn(rows: Rows, source: object) -> None:
    """Warn of the Gaussians of a file that the rasterizer leaves out, because a value is not finite.

    Infinite logits are drawn: programs that set the opacities 0 and 1 write them.
    """
    usable = [~values.isnan() if name == "opacity" else values.isfinite() for name, values in rows.items()]
    drawn = torch.stack([values.flatten(1).all(dim=1) for values in usable]).all(dim=0)
    if undrawn := int((~drawn).sum()):
        fault = "have values that are not finite, and are not drawn"
        print(f"warning: {undrawn} of {len(drawn)} Gaussians in {source} {fault}", file=sys.stderr)
