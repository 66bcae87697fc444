"""The public functions of fused_ssim, with autograd and fake kernels of its operators.

SSIM is that of Wang et al. 2004, per channel, with an 11 x 11 Gaussian window of sigma 1.5, C1 = 0.01² and C2 = 0.03².
Padding "same" takes pixels beyond the border as 0; "valid" leaves a rim of 5 pixels out of the mean. Only img1 receives
a gradient.
"""

import math

import torch
from torch import Tensor, library

from fused_ssim.backend import OPERATORS, has_kernels
from fused_ssim.first_order import direct_apply, first_order, function_of, is_compiled, needs_function

WINDOW = 11  # pixels
MAP_COLUMNS, MAP_ROW = 116, 408  # as in csrc/data.h
PADDINGS = ("same", "valid")


def fused_ssim(img1: Tensor, img2: Tensor, padding: str = "same", train: bool = True) -> Tensor:
    """Mean SSIM of two images: a scalar of img1's dtype (Wang et al. 2004, eq. 13).

    img1: (..., H, W), values in [0, 1], float32 or, on the CPU, float64. img2: the same shape, and the same dtype or
    uint8 (value / 255). padding: "same" (any size) or "valid" (11 x 11 pixels or more). train=False: there is no
    gradient, and nothing is kept for one. The same images on the same device give the same bits.
    Raises TypeError for a wrong dtype, ValueError for any other argument that does not fit.
    """
    return fused_l1_ssim(img1 if train else img1.detach(), img2, padding)[1]


def fused_l1_ssim(img1: Tensor, img2: Tensor, padding: str = "same") -> tuple[Tensor, Tensor]:
    """Mean |img1 - img2| and mean SSIM: two scalars. Arguments and errors are those of `fused_ssim`.

    The first mean is over all pixels, with either padding; its gradient is 0 where both images are equal. Nothing is
    kept for the gradient unless img1 needs one.
    """
    check_images(img1, img2, padding)
    train = needs_function(img1)
    # torch.compile knows the operators, whose autograd is registered below.
    function = _apply_l1_ssim if train and not is_compiled() else OPERATORS.l1_ssim
    return function(img1, img2.detach(), padding == "valid", train)[:2]


def fused_photometric_loss(
    img1: Tensor, img2: Tensor, lambda_dssim: float, clamp: bool = True
) -> tuple[Tensor, Tensor]:
    """The loss (1 - lambda) L1 + lambda (1 - SSIM) of Kerbl et al. 2023, eq. 7, and its L1: two scalars.

    Images and errors are those of `fused_ssim` with padding "same". With clamp, img1 is clamped to [0, 1] first; as
    with torch's clamp, it receives no gradient where it lies outside. The L1 has no gradient. Nothing is kept for the
    gradient unless img1 needs one.
    """
    check_images(img1, img2, "same")
    train = needs_function(img1)
    function = _apply_photometric if train and not is_compiled() else OPERATORS.photometric
    return function(img1, img2.detach(), float(lambda_dssim), train, clamp)[:2]


def composite(picture: Tensor, background: Tensor) -> Tensor:
    """Composites an image with straight alpha, (4, H, W) uint8, on a background (3,) float32 in [0, 1].

    Returns color / 255 * alpha + background * (1 - alpha), (3, H, W) float32, where alpha is value / 255; the same bits
    on every device. There is no gradient.
    Raises RuntimeError for other shapes and dtypes, and for tensors on two devices.
    """
    return OPERATORS.composite(picture, background)


def check_images(img1: Tensor, img2: Tensor, padding: str) -> None:
    """Check the arguments of `fused_ssim`; TypeError or ValueError for one that does not fit."""
    if padding not in PADDINGS:
        raise ValueError(f'padding must be "same" or "valid", got {padding!r}')
    if img1.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"img1 must be float32 or float64, got {img1.dtype}: convert with img1.float()")
    if img2.dtype not in (img1.dtype, torch.uint8):
        raise TypeError(f"img2 must be {img1.dtype} like img1, or uint8 (value / 255), got {img2.dtype}")
    shapes = f"img1 {tuple(img1.shape)} and img2 {tuple(img2.shape)}"
    if img1.shape != img2.shape:
        raise ValueError(f"the images must have the same shape, got {shapes}")
    if img1.dim() < 2 or img1.numel() == 0:
        raise ValueError(f"the images must be (..., H, W) with at least one pixel, got {shapes}")
    if padding == "valid" and min(img1.shape[-2:]) < WINDOW:
        raise ValueError(f'padding "valid" needs at least {WINDOW} x {WINDOW} pixels, got {shapes}: use "same"')
    if img1.device != img2.device:
        raise ValueError(f"the images must be on the same device, got img1 on {img1.device} and img2 on {img2.device}")
    device = img1.device.type
    if not has_backend(device):
        raise ValueError(f"this build of fused_ssim has no {device} backend: pass img1.cpu() and img2.cpu()")
    if device == "cuda" and img1.dtype != torch.float32:
        raise TypeError(f"img1 on {img1.device} must be float32, got {img1.dtype}: pass img1.float() or img1.cpu()")


def has_backend(device: str) -> bool:
    """Tell whether this build computes on devices of a type, "cpu" or "cuda"."""
    return has_kernels("l1_ssim", device)


@library.register_fake("fused_ssim::l1_ssim")
def _l1_ssim_fake(img1: Tensor, img2: Tensor, valid: bool, train: bool) -> tuple[Tensor, Tensor, Tensor]:
    return img1.new_empty(()), img1.new_empty(()), img1.new_empty(_kept_shape(img1) if train else (0,))


def _kept_shape(img1: Tensor) -> tuple[int, ...]:
    """Return the shape of what a forward keeps: on the CPU the gradient of SSIM, on a GPU three maps of its windows."""
    if img1.device.type != "cuda":
        return tuple(img1.shape)
    height, width = img1.shape[-2:]
    return math.prod(img1.shape[:-2]), (width + MAP_COLUMNS - 1) // MAP_COLUMNS, height, MAP_ROW


@library.register_fake("fused_ssim::l1_ssim_vjp")
@library.register_fake("fused_ssim::photometric_vjp")
def _vjp_fake(img1: Tensor, *_) -> Tensor:
    return img1.new_empty(img1.shape)


def _setup_context(ctx, inputs: tuple, output: tuple[Tensor, Tensor, Tensor]) -> None:
    img1, img2, _, _ = inputs
    ctx.mark_non_differentiable(output[2])
    ctx.save_for_backward(img1, img2, output[2])


@first_order("SSIM")
def _backward(ctx, grad_l1: Tensor, grad_ssim: Tensor, _) -> tuple[Tensor, None, None, None]:
    img1, img2, kept = ctx.saved_tensors
    return OPERATORS.l1_ssim_vjp(img1, img2, kept, grad_l1, grad_ssim), None, None, None


library.register_autograd("fused_ssim::l1_ssim", _backward, setup_context=_setup_context)


@library.register_fake("fused_ssim::photometric")
def _photometric_fake(
    img1: Tensor, img2: Tensor, lambda_dssim: float, train: bool, clamp: bool = True
) -> tuple[Tensor, Tensor, Tensor]:
    return _l1_ssim_fake(img1, img2, False, train)


@library.register_fake("fused_ssim::composite")
def _composite_fake(picture: Tensor, background: Tensor) -> Tensor:
    return background.new_empty((3, *picture.shape[1:]))


def _setup_photometric(ctx, inputs: tuple, output: tuple[Tensor, Tensor, Tensor]) -> None:
    img1, img2, ctx.lambda_dssim, _, ctx.clamp = inputs
    ctx.mark_non_differentiable(output[1], output[2])
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(img1, img2, output[2])


@first_order("the photometric loss")
def _photometric_backward(ctx, grad_loss: Tensor | None, *_) -> tuple[Tensor | None, None, None, None, None]:
    if grad_loss is None:
        return None, None, None, None, None
    gradient = OPERATORS.photometric_vjp(*ctx.saved_tensors, ctx.lambda_dssim, grad_loss, ctx.clamp)
    return gradient, None, None, None, None


# For callers of the operator itself, and for torch.compile.
library.register_autograd("fused_ssim::photometric", _photometric_backward, setup_context=_setup_photometric)

_apply_l1_ssim = direct_apply(function_of(OPERATORS.l1_ssim, _setup_context, _backward))
_apply_photometric = direct_apply(function_of(OPERATORS.photometric, _setup_photometric, _photometric_backward))
