"""Differentiable rasterizer for 3D Gaussian Splatting: the reference's API, and `rasterize`, which it wraps.

`optim` has the optimiser's kernels and `reference` the oracle.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from diff_gaussian_rasterization.backend import has_cuda_kernels
from diff_gaussian_rasterization.gaussians import Gaussians
from diff_gaussian_rasterization.ops import Rasterized, decisive, mark_visible, rasterize

__all__ = [
    "GaussianRasterizationSettings",
    "GaussianRasterizer",
    "Gaussians",
    "Rasterized",
    "decisive",
    "has_cuda_kernels",
    "rasterize",
]


class GaussianRasterizationSettings(NamedTuple):
    """The camera, and how to render; the first 13 fields are the reference's, in its order.

    Matrices are transposed: they act on row vectors. x points right, y down, z forward; pixel centres lie at integers.
    `projmatrix` is the full projection, view times projection, and contains the principal point.
    """

    image_height: int
    image_width: int
    tanfovx: float  # tan of half the field of view
    tanfovy: float
    bg: Tensor  # (3,)
    scale_modifier: float
    viewmatrix: Tensor  # (4, 4) world to view, transposed
    projmatrix: Tensor  # (4, 4) world to clip, transposed
    sh_degree: int  # active degree, 0..3
    campos: Tensor  # (3,) world
    prefiltered: bool  # accepted for compatibility; culling does not rely on it
    debug: bool  # check inputs, image and gradients for NaN and Inf; the error names the tensor and the place
    antialiasing: bool
    inverse_depth: bool = True  # False: the third result is None and nothing is computed for it


class GaussianRasterizer(nn.Module):
    """Rasterizes Gaussians with the reference's calling convention."""

    def __init__(self, raster_settings: GaussianRasterizationSettings) -> None:
        super().__init__()
        self.raster_settings = raster_settings

    def markVisible(self, positions: Tensor) -> Tensor:
        """Marks positions (N, 3) whose z in the view is above 0.2: (N,) bool. As in the reference: no frustum test."""
        with torch.no_grad():
            return mark_visible(positions, self.raster_settings.viewmatrix)

    def forward(
        self,
        means3D: Tensor,
        means2D: Tensor,
        opacities: Tensor,
        shs: Tensor | None = None,
        colors_precomp: Tensor | None = None,
        scales: Tensor | None = None,
        rotations: Tensor | None = None,
        cov3D_precomp: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Renders activated Gaussians.

        means3D (N, 3): world. means2D (N, 3): values unused; receives d loss / d mean on the image, per NDC unit.
        opacities (N, 1): in [0, 1]. shs (N, K, 3): bands beyond the active degree are not read; or colors_precomp
        (N, 3). scales (N, 3): positive, and rotations (N, 4): w x y z, both used as they are; or cov3D_precomp (N, 6):
        xx, xy, xz, yy, yz, zz.
        Returns colour (3, H, W), radii (N,) int32 in px, and the inverse depth (1, H, W), the sum of alpha T / z.
        Raises Exception unless exactly one of each pair of alternatives is given, and as `rasterize`.
        """
        if (shs is None) == (colors_precomp is None):
            raise Exception("give exactly one of shs and colors_precomp")
        given = scales is not None or rotations is not None
        if given == (cov3D_precomp is not None) or (given and (scales is None or rotations is None)):
            raise Exception("give exactly one of the pair scales, rotations and cov3D_precomp")
        if shs is not None and len(getattr(shs, "shape", ())) != 3:
            raise ValueError(f"shs must be (N, K, 3), got {tuple(getattr(shs, 'shape', ()))}")
        settings = self.raster_settings
        out = rasterize(
            means3D,
            means2D,
            opacities,
            settings,
            scales=scales,
            rotations=rotations,
            cov3d=cov3D_precomp,
            colors=colors_precomp,
            sh_dc=None if shs is None else shs[:, :1],
            sh_rest=None if shs is None else shs[:, 1:],
            want_inverse_depth=settings.inverse_depth,
        )
        return out.color, out.radii, out.inverse_depth
