"""Error of a render at each pixel, and which pixels count."""

import torch
from torch import Tensor

ERRORS = ("l1", "squared")


def error_map(
    kind: str, image: Tensor, target: Tensor, mask: Tensor | None = None, columns: slice | None = None
) -> Tensor:
    """Errors (1, H, W) whose sum is the mean error of the image, as in the loss; 0 where a pixel does not count.

    kind: of ERRORS. l1: mean of |image - target| over the channels; squared: that of the square. image (3, H, W)
    float32, clamped here; target the same shape, float32, or uint8 meaning value / 255. mask, columns: as for
    `photometric_loss`.
    """
    difference = image.clamp(0, 1) - (target.float() / 255 if target.dtype == torch.uint8 else target)
    red, green, blue = difference.abs() if kind == "l1" else difference * difference
    errors = ((red + green + blue) / 3)[None]
    if columns is not None:
        counting = torch.zeros_like(errors, dtype=torch.bool)
        counting[..., columns] = True
        mask = counting if mask is None else mask & counting
    if mask is None:
        return errors / errors.numel()
    return torch.where(mask, errors, 0.0) / mask.sum().clamp_min(1)
