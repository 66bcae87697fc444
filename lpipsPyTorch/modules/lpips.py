"""The network that compares images."""

import torch
from torch import Tensor, nn

from utils.lpips_utils import NETS, load_network


class LPIPS(nn.Module):
    """LPIPS (Zhang et al. 2018, version 0.1) with the backbone "alex", "vgg" or "squeeze".

    The backbone's weights come from torch's cache, or are downloaded into it. Raises ValueError for other nets and
    versions, and LpipsUnavailable, which says where to put the weights, if there are none.
    """

    def __init__(self, net_type: str = "alex", version: str = "0.1") -> None:
        """Load the network.

        net_type: backbone, "alex", "vgg" or "squeeze".
        version: "0.1", the only one.
        """
        super().__init__()
        if version != "0.1":
            raise ValueError(f"LPIPS has version 0.1 here, got {version!r}: leave the argument out")
        if net_type not in NETS:
            raise ValueError(f"net_type must be one of {', '.join(NETS)}, got {net_type!r}")
        self.net = load_network(net_type, None, torch.device("cpu"))

    def forward(self, x: Tensor, y: Tensor) -> Tensor:
        """Distance of images (B, 3, H, W) or (3, H, W): (1, 1, 1, 1), the sum over the batch; differentiable.

        Values are passed on unchanged. The network expects [-1, 1], but tables of 3DGS come from images in [0, 1].
        """
        x, y = (image[None] if image.dim() == 3 else image for image in (x, y))
        return self.net(x, y).sum(0, keepdim=True)

    def train(self, mode: bool = True) -> "LPIPS":
        """Stay in evaluation mode: in training mode, dropout makes the distance random."""
        return super().train(False)
