"""Observations of each Gaussian between two densifications (Kerbl et al. 2023, section 5.2)."""

from dataclasses import dataclass, fields

import torch
from diff_gaussian_rasterization.optim import observe_
from torch import Tensor


@dataclass
class Statistics:
    """Observations of N Gaussians; the names are the reference's.

    max_radii2D (N,): largest radius in pixels. xyz_gradient_accum (N, 1): sum of the lengths of the screen-space
    gradients, or of the absolute ones, per NDC unit. denom (N, 1): number of views in that sum. All are float32.
    """

    max_radii2D: Tensor
    xyz_gradient_accum: Tensor
    denom: Tensor

    @classmethod
    def zero(cls, count: int, device: torch.device | str) -> "Statistics":
        """Statistics of `count` Gaussians without any observation."""
        return cls(*(torch.zeros(shape, device=device) for shape in ((count,), (count, 1), (count, 1))))

    def observe(self, gradient: Tensor, radii: Tensor) -> None:
        """Add a view in one pass: gradient (N, 3) per NDC unit, radii (N,) int32 pixels, 0 if not seen.

        A gradient of shape (N,) has the lengths themselves.
        """
        observe_(self.max_radii2D, self.xyz_gradient_accum, self.denom, radii, gradient)

    def add_gradient(self, gradient: Tensor, visible: Tensor) -> None:
        """Add a view without its radii: gradient (N, 3) per NDC unit; visible: indices (n,), (n, 1), or a mask (N,)."""
        x, y = gradient[:, 0], gradient[:, 1]
        length = (x * x + y * y).sqrt()[:, None]
        if visible.dtype != torch.bool:
            none = torch.zeros(len(gradient), dtype=torch.bool, device=length.device)
            visible = none.index_fill_(0, visible.reshape(-1), True)
        self.xyz_gradient_accum += torch.where(visible[:, None], length, 0.0)
        self.denom += visible[:, None]

    def to(self, device: torch.device | str) -> "Statistics":
        """The same statistics on a device."""
        return Statistics(*(getattr(self, name).to(device) for name in NAMES))


NAMES = tuple(field.name for field in fields(Statistics))
PER_ROW = *NAMES, "tmp_radii"  # attributes of a model with a row per Gaussian, unless they are None
