"""The description of splats: a function of autograd between projection and blending, for programs of gsplat.

It turns splats into means, conics and opacities, as these programs know them.

Gradients that come back from it changed are turned into moments (stages.py).
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function

from diff_gaussian_rasterization.backend import OPERATORS
from diff_gaussian_rasterization.first_order import direct_apply, first_order
from diff_gaussian_rasterization.stages import Shared

_TWO_LN2 = 1.3862943611198906


class _Described(Function):
    """Inputs: `Shared`, height and width, whether rows are packed, splats that keep their shapes, depths, tile_counts.

    Results (1, N, ...), or of the rows that are shown: radii, means2d, depths, conics, opacities, tiles, then the rows.
    """

    @staticmethod
    def forward(
        ctx: Any, shared: Shared, size: tuple[int, int], packed: bool, splats: Tensor, depths: Tensor,
        tile_counts: Tensor,
    ) -> tuple[Tensor | None, ...]:  # fmt: skip
        """Describe the splats, and keep what turns gradients of the description into moments."""
        with torch._C._AutoDispatchBelowAutograd():
            *found, tiles, rows = OPERATORS.describe(splats, depths, tile_counts, *size, packed)
        if packed:
            found.append(tiles)
        else:
            found, rows = [values[None] for values in (*found, tile_counts)], None
        ctx.shared, shared.describe_moments = shared, describe_moments
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(splats, tile_counts, rows, found[0])
        ctx.mark_non_differentiable(found[0], found[5])
        if packed:
            ctx.mark_non_differentiable(rows)
        return *found, rows

    @staticmethod
    @first_order("rasterization")
    def backward(ctx: Any, _: Any, centers: Tensor, of_depth: Tensor, conics: Tensor, opacities: Tensor, *__) -> tuple:
        """Return the moments that blending has sent, corrected where gradients of the description differ from these.

        The gradients differ if a hook has changed them, or if a loss depends on the description.
        """
        splats, tile_counts, rows, radii = ctx.saved_tensors
        moments, marks = ctx.shared.take()
        given = [centers, conics, opacities]
        same = [None if values is None else (values.data_ptr(), values._version) for values in given] == marks
        same = same and not any(hooks() for hooks in ctx.shared.hooks)  # which may change values and no mark
        if not same or of_depth is not None:
            if rows is None:
                shown = torch.maximum(tile_counts, radii[0].amin(-1))
            else:
                shown = tile_counts.index_fill(0, rows, 1)
            ctx.shared.shown = shown
        if not same:
            moments = torch.zeros_like(splats) if moments is None else moments
            sent = OPERATORS.describe_vjp(splats, tile_counts, moments)
            dense = [own if got is None else _to_dense(got, rows, splats) for got, own in zip(given, sent, strict=True)]
            moments = _merge_changes(moments, splats, shown, sent, dense)
        if of_depth is not None:
            of_depth = torch.where(shown > 0, _to_dense(of_depth, rows, splats), 0)
        return None, None, None, moments, of_depth, None


def describe_moments(splats: Tensor, tile_counts: Tensor, moments: Tensor, rows: Tensor | None) -> Sequence[Tensor]:
    """Gradients of means2d, conics and opacities, as they are described."""
    found = OPERATORS.describe_vjp(splats, tile_counts, moments, rows)
    return [values[None] for values in found] if rows is None else found


def _to_dense(packed: Tensor, rows: Tensor | None, splats: Tensor) -> Tensor:
    """A value for each Gaussian, of a gradient of `_Described`."""
    if rows is None:
        return packed[0]
    return packed.new_zeros(len(splats), *packed.shape[1:]).index_copy_(0, rows, packed)


def _merge_changes(
    moments: Tensor, splats: Tensor, shown: Tensor, sent: Sequence[Tensor], given: Sequence[Tensor]
) -> Tensor:
    """Moments, but of what is given where that is not what was sent: gradients of means2d, conics and opacities."""
    l11, l12, l22 = splats[:, 2].abs(), splats[:, 3], splats[:, 4]
    centers, conics, opacities = given
    u, xx, xy, yy = centers[:, 0] / (_TWO_LN2 * l11), -2 * conics[:, 0], -conics[:, 1], -2 * conics[:, 2]
    mean = u, (centers[:, 1] / _TWO_LN2 - l12 * u) / l22
    shape = l11 * l11 * xx + 2 * l11 * l12 * xy + l12 * l12 * yy, l22 * (l11 * xy + l12 * yy), l22 * l22 * yy
    made = torch.stack([opacities * splats[:, 5].exp2(), *mean, *shape], 1)
    moved, bent, dimmed = (got != own for got, own in zip(given, sent, strict=True))
    differ = torch.stack([dimmed, *[moved.any(1)] * 2, *[bent.any(1)] * 3], 1) & (shown > 0)[:, None]
    return torch.cat([torch.where(differ, made, moments[:, :6]), moments[:, 6:]], 1)


described = direct_apply(_Described)
