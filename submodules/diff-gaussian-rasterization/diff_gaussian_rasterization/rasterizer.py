"""The reference's calling convention, in its forms of 2023 and 2024, over `rasterize`."""

import torch
from torch import Tensor, nn

from diff_gaussian_rasterization.alternatives import chosen, given, shaped
from diff_gaussian_rasterization.checks import check_tensors
from diff_gaussian_rasterization.ops import mark_visible, rasterize
from diff_gaussian_rasterization.settings import GaussianRasterizationSettings

Rendering = tuple[Tensor, Tensor] | tuple[Tensor, Tensor, Tensor | None]


class GaussianRasterizer(nn.Module):
    """Rasterizes Gaussians with the reference's calling convention."""

    def __init__(self, raster_settings: GaussianRasterizationSettings) -> None:
        super().__init__()
        self.raster_settings = raster_settings

    def markVisible(self, positions: Tensor) -> Tensor:
        """Marks positions (N, 3) whose z in the view is above 0.2: (N,) bool. As in the reference: no frustum test."""
        with torch.no_grad():
            return mark_visible(positions, shaped(self.raster_settings.viewmatrix, 4, 4))

    def forward(
        self,
        means3D: Tensor,
        means2D: Tensor | None,
        opacities: Tensor,
        shs: Tensor | None = None,
        colors_precomp: Tensor | None = None,
        scales: Tensor | None = None,
        rotations: Tensor | None = None,
        cov3D_precomp: Tensor | None = None,
        *,
        dc: Tensor | None = None,
    ) -> Rendering:
        """Renders activated Gaussians.

        means3D (N, 3): world. means2D (N, 3): values unused; receives d loss / d mean on the image, per NDC unit; one
        that needs no gradient may have any form, or be None. opacities (N, 1): in [0, 1]. shs (N, K, 3): bands beyond
        the active degree are not read; with dc (N, 1, 3), the band of degree 0, shs (N, K - 1, 3) has the others; or
        colors_precomp (N, 3). scales (N, 3): positive, and rotations (N, 4): w x y z, both used as they are; or
        cov3D_precomp (N, 6): xx, xy, xz, yy, yz, zz. An empty tensor of one axis counts as None.

        Returns colour (3, H, W), radii (N,) int32 in px, and the inverse depth (1, H, W), the sum of alpha T / z.
        Settings without `antialiasing`, as in 2023, give colour and radii alone.
        Raises Exception unless exactly one of each pair of alternatives is given, and TypeError for other types than
        tensors.
        """
        shs, dc, colors_precomp, scales, rotations, cov3D_precomp = map(
            given, (shs, dc, colors_precomp, scales, rotations, cov3D_precomp)
        )
        if (shs is None and dc is None) == (colors_precomp is None):
            raise Exception("give exactly one of shs and colors_precomp")
        shaped = scales is not None or rotations is not None
        if shaped == (cov3D_precomp is not None) or (shaped and (scales is None or rotations is None)):
            raise Exception("give exactly one of the pair scales, rotations and cov3D_precomp")
        shape = scales, rotations, cov3D_precomp
        return rasterize_gaussians(
            means3D, means2D, shs, colors_precomp, opacities, *shape, self.raster_settings, dc=dc
        )


def rasterize_gaussians(
    means3D: Tensor,
    means2D: Tensor | None,
    sh: Tensor | None,
    colors_precomp: Tensor | None,
    opacities: Tensor,
    scales: Tensor | None,
    rotations: Tensor | None,
    cov3Ds_precomp: Tensor | None,
    raster_settings: GaussianRasterizationSettings,
    *,
    dc: Tensor | None = None,
) -> Rendering:
    """Does what `GaussianRasterizer` does, with all inputs by place. Of two alternatives the precomputed one counts."""
    optional = {"sh": sh, "dc": dc, "colors_precomp": colors_precomp, "scales": scales, "rotations": rotations}
    optional |= {"cov3Ds_precomp": cov3Ds_precomp}
    check_tensors({"means3D": means3D, "means2D": means2D, "opacities": opacities} | optional)
    gaussians = chosen(means3D, opacities, scales, rotations, cov3Ds_precomp, colors_precomp, sh, dc)
    # Only its gradient counts, so what needs none is not looked at.
    means2d = None if means2D is None or not means2D.requires_grad else means2D.to(means3D)
    with_depth = raster_settings.antialiasing is not None
    out = rasterize(
        means2d=means2d,
        settings=raster_settings,
        want_inverse_depth=with_depth and raster_settings.inverse_depth,
        **gaussians._asdict(),
    )
    return (out.color, out.radii, out.inverse_depth) if with_depth else (out.color, out.radii)


def cpu_deep_copy_tuple(input_tuple: tuple) -> tuple:
    """Copies a tuple; its tensors are copied to the CPU."""
    return tuple(value.to("cpu", copy=True) if isinstance(value, Tensor) else value for value in input_tuple)
