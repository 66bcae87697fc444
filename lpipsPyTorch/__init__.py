"""LPIPS of images, by the name under which code for the reference imports it."""

from functools import cache

import torch
from torch import Tensor

from lpipsPyTorch.modules.lpips import LPIPS

__all__ = ["lpips"]


def lpips(x: Tensor, y: Tensor, net_type: str = "alex", version: str = "0.1") -> Tensor:
    """Distance of images (B, 3, H, W) or (3, H, W), computed by an `LPIPS` on the device of x: (1, 1, 1, 1).

    Networks are kept, so that only the first call with a net and a device takes long.
    """
    return _network(net_type, version, x.device)(x, y)


@cache
def _network(net_type: str, version: str, device: torch.device) -> LPIPS:
    with torch.inference_mode(False):  # so that a later call can have gradients
        return LPIPS(net_type, version).to(device)
