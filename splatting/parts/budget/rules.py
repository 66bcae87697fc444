"""Changes of a model's Gaussians on their way to a given number: split in two, fade."""

import torch
from torch import Tensor

from scene.gaussians.long_axis import long_axis_children
from scene.gaussians.parameters import GaussianParameters
from splatting.deterministic.portable_math import exp, log
from splatting.distributed.rows import changes_rows


@torch.no_grad()
@changes_rows
def split_in_two(gaussians: GaussianParameters, parents: Tensor) -> None:
    """Split Gaussians, ascending indices (n,), along their longest axis (scene/gaussians/long_axis.py).

    One child takes its parent's row, the other is appended. Adam's averages of both begin at zero, so that their first
    steps are long: with the parent's averages they would stay almost where they are.
    """
    count = len(parents)
    if not gaussians.shards.ranks.anyone(count > 0):
        return
    rows = gaussians.rows_at(parents)
    shapes = gaussians.log_scales(), gaussians.opacity_logits()
    log_scales, logits = (values.index_select(0, parents) for values in shapes)
    children = long_axis_children(rows["xyz"], log_scales, rows["rotation"], logits)
    children |= gaussians.raw_shapes(children["opacity"], children["scaling"])
    second = rows | {name: values[count:] for name, values in children.items()}
    gaussians._take(gaussians.cat_tensors_to_optimizer(second))
    gaussians.shards.appended(count)
    gaussians.shards.order(gaussians.shards.items(parents))
    gaussians._zero_statistics()
    for name, values in children.items():
        gaussians.raw(name)[parents] = values[:count]
    gaussians.table.restart(parents)


@torch.no_grad()
def fade(gaussians: GaussianParameters, factor: float) -> None:
    """Multiply all opacities by a factor in (0, 1]. Adam's averages stay."""
    if factor < 1.0:
        logits = faded(gaussians.opacity_logits(), factor)
        gaussians.raw("opacity").copy_(gaussians.raw_opacity(logits))


def faded(logits: Tensor, factor: float) -> Tensor:
    """Logits (N, 1) of opacities multiplied by a factor in (0, 1): same bits on every device.

    With a = 1 / (1 + e), e = exp(-logit), factor a / (1 - factor a) is factor / (e + 1 - factor).
    """
    below = exp(-logits) + (1.0 - factor)
    return (log(torch.full_like(below, factor)) - log(below)).to(logits.dtype)
