"""Images of any number of channels, blended over one sorted list: colours, features, depths.

The kernels blend up to 32 channels at once. Projection and sorting are computed once for all of them.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from diff_gaussian_rasterization.backend import OPERATORS
from diff_gaussian_rasterization.camera import camera_numbers
from diff_gaussian_rasterization.checks import check_finite, check_tensors
from diff_gaussian_rasterization.first_order import first_order
from diff_gaussian_rasterization.gaussians import Gaussians, lists_gaussians
from diff_gaussian_rasterization.scene import Scene, scene_arguments
from diff_gaussian_rasterization.settings import GaussianRasterizationSettings

MOST_CHANNELS = 32  # that are blended at once: kMostChannels in csrc/data.h
_MOST_ALPHA = 0.99  # kMaxAlpha in csrc/math/constants.h
_GAUSSIANS = len(Gaussians._fields)


class ChannelImage(NamedTuple):
    """The result of `rasterize_channels`."""

    image: Tensor  # (C, H, W), background included
    transmittance: Tensor  # (1, H, W): what is left for the background
    radii: Tensor  # (N,) int32, px: ceil of 3 sigma, 0 where culled
    splats: Tensor  # (N, 10 or more): mean (px), factor of the conic, log2 of the opacity; see `Splat` in csrc/math
    depths: Tensor  # (N,) along the axis of the view; of fisheyes and panoramas the distance
    tile_counts: Tensor  # (N,) int32, tiles that each Gaussian reaches


class _Blending(NamedTuple):
    """How alphas are blended, and what else is wanted."""

    cap: float  # the largest alpha
    stops: bool  # whether gradients end there
    colored: bool  # whether colours come before the features
    absolute: bool  # whether absolute gradients are wanted


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

    features (N, F): further channels, finite; or all of them, where neither colours nor SH are given. depths (N,): what
    orders the Gaussians, in place of their depths in the view. any_rotation: rotations have any length, though others
    are not raw. most_alpha: a larger alpha counts as this one, without a gradient; None: 0.99, where the gradient
    passes. settings.bg: (C,) or (1,). Differentiable in all of these but depths. Other arguments and errors are those
    of `rasterize`; absolute gradients need at most 32 channels. Gaussians on the rays of a lens have three channels
    only: ValueError.
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
        gaussians = gaussians._replace(colors=means.new_zeros(len(means), 3))  # projection asks for a colour
    if want_absolute_gradient and count > MOST_CHANNELS:
        raise ValueError(f"absolute gradients need at most {MOST_CHANNELS} channels, got {count}")
    if settings.projection == "ray" and settings.lens is not None:
        raise ValueError("Gaussians on the rays of a lens have three channels only; take projection='ewa'")
    if most_alpha is not None and not 1 / 255 < most_alpha < 1:
        raise ValueError(f"most_alpha must be above 1/255 and below 1, got {most_alpha}")
    background = settings.bg.to(means).reshape(-1)
    if len(background) not in (1, count):
        raise ValueError(f"the background must have {count} values, or one for all, got {len(background)}")
    blending = _Blending(most_alpha or _MOST_ALPHA, most_alpha is not None, colored, want_absolute_gradient)
    scene = scene_arguments(gaussians, settings, 1 if raw else 2 * any_rotation)
    camera = camera_numbers(scene, settings)
    return ChannelImage(*_Channels.apply(blending, depths, camera, means2d, features, background, *scene))


def _check(
    given: dict[str, Tensor | None],
    means2d: Tensor | None,
    depths: Tensor | None,
    settings: GaussianRasterizationSettings,
) -> None:
    """What the operators that are called do not check, or without the names of the inputs."""
    check_tensors(given | {"means2d": means2d, "depths": depths, "bg": settings.bg})
    means = given["means"]
    if means2d is not None and (means2d.shape != means.shape or means2d.dtype != means.dtype):
        found = f"{tuple(means2d.shape)} of {means2d.dtype}"
        raise ValueError(f"means2d must be {tuple(means.shape)} of {means.dtype}, got {found}")
    if settings.debug:
        for name, values in given.items():
            if values is not None:
                check_finite(name, values)


class _Channels(torch.autograd.Function):
    """Inputs: `_Blending`, depths, the camera's numbers, means2d, features, the background, and `Scene`'s."""

    @staticmethod
    def forward(ctx, blending, order, camera, means2d, features, background, *scene):
        with torch._C._AutoDispatchBelowAutograd():
            given = Scene(*scene)
            splats, depths, rects, tile_counts, radii = OPERATORS.project(*given)
            lists = OPERATORS.bin(splats, depths if order is None else order, rects, tile_counts, *given.size, True)
            values = torch.cat([splats[:, 6:9], features], 1) if blending.colored else features
            behind = background.expand(values.shape[1])
            image, transmittance, last = OPERATORS.blend_channels(
                splats, values, *lists[:2], behind, *given.size, blending.cap
            )
        ctx.blending, ctx.numbers, ctx.background = blending, scene[11:], background.shape
        ctx.set_materialize_grads(False)
        kept = splats, tile_counts, *lists, last, splats.new_zeros(0), behind, transmittance
        ctx.save_for_backward(*scene[:11], values, *kept)
        ctx.mark_non_differentiable(radii, splats, depths, tile_counts)
        return image, transmittance, radii, splats, depths, tile_counts

    @staticmethod
    @first_order("rasterize_channels")
    def backward(ctx, grad_image, grad_transmittance, *_):
        blending, needed = ctx.blending, ctx.needs_input_grad
        scene, values, kept = (*ctx.saved_tensors[:11], *ctx.numbers), ctx.saved_tensors[11], ctx.saved_tensors[12:]
        splats, tile_counts, last, transmittance = kept[0], kept[1], kept[6], kept[9]
        if grad_image is None:
            grad_image = splats.new_zeros(values.shape[1], *last.shape)
        rows, counts, of_values = OPERATORS.channel_rows(
            kept, values, grad_image, grad_transmittance, blending.cap, blending.stops, blending.absolute, needed[4]
        )
        source, results = (splats, tile_counts, rows, counts), [None] * len(needed)
        if needed[2]:
            results[2] = OPERATORS.sum_blocks(OPERATORS.camera_vjp(*scene, source, blending.absolute))
        if needed[4]:
            results[4] = of_values[:, 3:] if blending.colored else of_values
        if needed[5]:
            results[5] = torch.mv(grad_image.flatten(1), transmittance.flatten()).sum_to_size(ctx.background)
        places = [3, *range(6, 6 + _GAUSSIANS)]
        wanted = [needed[at] for at in places]
        if any(wanted):
            gradients = OPERATORS.rasterize_vjp(*scene, wanted, source, None, None, None, blending.absolute)
            for at, gradient in zip(places, gradients, strict=True):
                results[at] = gradient if needed[at] else None
        return tuple(results)
