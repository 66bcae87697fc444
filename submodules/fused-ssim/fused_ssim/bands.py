"""The photometric loss of an image of which each of several processes has a band of rows."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from fused_ssim.backend import OPERATORS
from fused_ssim.first_order import first_order
from fused_ssim.ops import check_images

BAND_ROWS = 16  # a band begins at a multiple of it, and ends at one or with the image; as in csrc/data.h
REACH = 10  # rows beside a band that its gradient depends on: SSIM reads 5, and its gradient 5 more


def photometric_loss_by_bands(
    img1: Tensor,
    img2: Tensor,
    lambda_dssim: float,
    rows: tuple[int, int],
    add: Callable[[Tensor], Tensor],
    clamp: bool = True,
) -> tuple[Tensor, Tensor]:
    """Return `fused_photometric_loss` of the whole image, bit for bit, and its gradient in rows [first, end).

    Other rows of the gradient have any values. Raises what `fused_photometric_loss` raises, and ValueError for rows
    that are no band.

    img1, img2: (..., H, W), of which only these rows and REACH more on either side count.
    lambda_dssim: weight of 1 - SSIM.
    rows: first row of this process's band, and the end.
    add: sums a tensor of float64 over all processes, whose bands make up the image; each number is 0 on all but one.
    clamp: true to clamp img1 to [0, 1] first.
    """
    check_images(img1, img2, "same")
    return _Banded.apply(img1, img2.detach(), float(lambda_dssim), rows, add, clamp)


class _Banded(torch.autograd.Function):
    """The loss of all bands, whose gradient is that of this process's rows."""

    @staticmethod
    def forward(
        ctx: Any, img1: Tensor, img2: Tensor, lambda_dssim: float, rows: tuple[int, int], add: Callable, clamp: bool
    ):
        """Return the loss and L1, scalars, of the sums over all bands."""
        sums, kept = OPERATORS.photometric_band(img1, img2, *rows, clamp)
        loss, l1 = OPERATORS.photometric_of_sums(img1, add(sums), lambda_dssim)
        ctx.mark_non_differentiable(l1)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(img1, img2, kept)
        ctx.lambda_dssim, ctx.rows, ctx.clamp = lambda_dssim, rows, clamp
        return loss, l1

    @staticmethod
    @first_order("the photometric loss")
    def backward(ctx: Any, grad_loss: Tensor | None, *_: Any) -> tuple[Tensor | None, None, None, None, None, None]:
        if grad_loss is None:
            return None, None, None, None, None, None
        gradient = OPERATORS.photometric_vjp(*ctx.saved_tensors, ctx.lambda_dssim, grad_loss, ctx.clamp, ctx.rows)
        return gradient, None, None, None, None, None
