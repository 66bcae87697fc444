"""Images of any number of channels, blended over one sorted list: colours, features, depths.

The kernels blend up to 32 channels at once. Projection and sorting are computed once for all of them.
"""

from typing import NamedTuple

from torch import Tensor

from diff_gaussian_rasterization.camera import camera_numbers
from diff_gaussian_rasterization.checks import check_finite, check_tensors
from diff_gaussian_rasterization.first_order import needs_function
from diff_gaussian_rasterization.gaussians import Gaussians, lists_gaussians
from diff_gaussian_rasterization.scene import scene_arguments
from diff_gaussian_rasterization.settings import GaussianRasterizationSettings
from diff_gaussian_rasterization.stages import Blending, Shared, blended, projected

MOST_CHANNELS = 32  # that are blended at once: kMostChannels in csrc/data.h
_MOST_ALPHA = 0.99  # kMaxAlpha in csrc/math/constants.h


class ChannelImage(NamedTuple):
    """The result of `rasterize_channels`."""

    image: Tensor  # (C, H, W), background included
    transmittance: Tensor  # (1, H, W): what is left for the background
    radii: Tensor  # (N,) int32, px: ceil of 3 sigma, 0 where culled
    splats: Tensor  # (N, 10 or more): mean (px), factor of the conic, log2 of the opacity; see `Splat` in csrc/math
    depths: Tensor  # (N,) along the axis of the view; of fisheyes and panoramas the distance
    tile_counts: Tensor  # (N,) int32, tiles that each Gaussian reaches


@lists_gaussians
def rasterize_channels(
    means: Tensor,
    means2d: Tensor,
    opacities: Tensor,
    settings: GaussianRasterizationSettings,
    *,
    features: Tensor | None = None,
    depths: Tensor | None = None,
    raw: bool = False,
    any_rotation: bool = False,
    want_absolute_gradient: bool = False,
    most_alpha: float | None = None,
    **others: Tensor | None,
) -> ChannelImage:
    """Renders Gaussians with C channels: the colours, if there are any, then the features.

    Differentiable in all tensors but depths. Other arguments and errors are those of `rasterize`; absolute gradients
    need at most 32 channels. Gaussians on the rays of a lens have three channels only: ValueError.

    features: (N, F), further channels, finite; or all channels, where neither colours nor SH are given.
    depths: (N,), order of the Gaussians, in place of their depths in the view.
    any_rotation: True if rotations have any length, though other parameters are not raw.
    most_alpha: a larger alpha counts as this one, without a gradient; None: 0.99, where the gradient passes.
    settings.bg: (C,) or (1,).
    """
    gaussians = Gaussians(means, opacities, **others)
    _check(gaussians._asdict() | {"features": features}, means2d, depths, settings)
    if features is None:
        features = means.new_empty(len(means), 0)
    if features.shape[:1] != means.shape[:1] or features.dim() != 2 or features.dtype != means.dtype:
        found = f"{tuple(features.shape)} of {features.dtype}"
        raise ValueError(f"features must be ({len(means)}, F) of {means.dtype}, got {found}")
    colored = gaussians.colors is not None or gaussians.sh_dc is not None
    count = features.shape[1] + 3 * colored
    if not count:
        raise ValueError("features must have a channel where neither colours nor SH are given")
    if not colored:
        gaussians = gaussians._replace(colors=means.detach())  # projection asks for some; nothing shows them
    if want_absolute_gradient and count > MOST_CHANNELS:
        raise ValueError(f"absolute gradients need at most {MOST_CHANNELS} channels, got {count}")
    if settings.projection == "ray" and settings.lens is not None:
        raise ValueError("Gaussians on the rays of a lens have three channels only; take projection='ewa'")
    if most_alpha is not None and not 1 / 255 < most_alpha < 1:
        raise ValueError(f"most_alpha must be above 1/255 and below 1, got {most_alpha}")
    background = settings.bg.to(means).reshape(-1)
    if len(background) not in (1, count):
        raise ValueError(f"the background must have {count} values, or one for all, got {len(background)}")
    scene = scene_arguments(gaussians, settings, 1 if raw else 2 * any_rotation)
    stops = most_alpha is not None
    how = Blending(scene.size, most_alpha if stops else _MOST_ALPHA, stops, colored, want_absolute_gradient)
    shared, camera = Shared(), camera_numbers(scene, settings)
    train = needs_function(*gaussians, means2d, features, background, camera)
    splats, own_depths, tile_counts, radii, *lists = projected(
        shared, train if depths is None else None, camera, means2d, *scene
    )
    lists = own_depths.detach() if depths is None else depths, lists, tile_counts, None
    own = None if colored and not features.shape[1] else features
    image, transmittance, *_ = blended(shared, how, train, *lists, splats, None, None, None, None, own, background)
    return ChannelImage(image, transmittance, radii, splats.detach(), own_depths.detach(), tile_counts)


def _check(
    given: dict[str, Tensor | None],
    means2d: Tensor | None,
    depths: Tensor | None,
    settings: GaussianRasterizationSettings,
) -> None:
    """Check inputs that the called operators do not check, or only without naming the inputs."""
    check_tensors(given | {"means2d": means2d, "depths": depths, "bg": settings.bg})
    means = given["means"]
    if means2d is not None and (means2d.shape != means.shape or means2d.dtype != means.dtype):
        found = f"{tuple(means2d.shape)} of {means2d.dtype}"
        raise ValueError(f"means2d must be {tuple(means.shape)} of {means.dtype}, got {found}")
    if settings.debug:
        for name, values in given.items():
            if values is not None:
                check_finite(name, values)
