"""Images of any number of channels, blended over one sorted list: colours, features, depths.

A pass of the kernels blends four channels, in the places of a splat's colour and inverse depth. Projection, sorting and
the gradients of the Gaussians' shapes are computed once for all passes.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from diff_gaussian_rasterization.backend import OPERATORS
from diff_gaussian_rasterization.camera import camera_numbers
from diff_gaussian_rasterization.checks import check_finite, check_tensors
from diff_gaussian_rasterization.fakes import SPLAT_VALUES
from diff_gaussian_rasterization.first_order import first_order
from diff_gaussian_rasterization.gaussians import Gaussians, lists_gaussians
from diff_gaussian_rasterization.scene import Scene, scene_arguments
from diff_gaussian_rasterization.settings import GaussianRasterizationSettings

_COLORS = 3
_PASS = 4  # channels of a pass
_SHOWN = SPLAT_VALUES - _PASS  # where a splat's channels begin, and those of a gradient row
_GAUSSIANS = len(Gaussians._fields)


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
    want_absolute_gradient: bool = False,
    **others: Tensor | None,
) -> ChannelImage:
    """Renders Gaussians with C channels: the colours, if there are any, then the features.

    features (N, F): further channels, finite; or all of them, where neither colours nor SH are given. depths (N,): what
    orders the Gaussians, in place of their depths in the view. settings.bg: (C,) or (1,). Differentiable in all of
    these but depths. Other arguments and errors are those of `rasterize`; absolute gradients need at most 4 channels.
    Gaussians on the rays of a lens have three channels only: ValueError.
    """
    gaussians = Gaussians(means, opacities, **others)
    _check(gaussians._asdict() | {"features": features}, means2d, depths, settings)
    if features is None:
        features = means.new_empty(len(means), 0)
    if features.shape[:1] != means.shape[:1] or features.dim() != 2 or features.dtype != means.dtype:
        found = f"{tuple(features.shape)} of {features.dtype}"
        raise ValueError(f"features must be ({len(means)}, F) of {means.dtype}, got {found}")
    shown = features.shape[1]
    if gaussians.colors is None and gaussians.sh_dc is None:
        lacking = max(0, _COLORS - shown)
        first = torch.nn.functional.pad(features[:, :_COLORS], (0, lacking))
        gaussians, features = gaussians._replace(colors=first), features[:, _COLORS:]
    else:
        shown += _COLORS
    if want_absolute_gradient and shown > _PASS:
        raise ValueError(f"absolute gradients need at most {_PASS} channels, got {shown}")
    if settings.projection == "ray" and settings.lens is not None:
        raise ValueError("Gaussians on the rays of a lens have three channels only; take projection='ewa'")
    scene = scene_arguments(gaussians, settings, raw)
    camera = camera_numbers(scene, settings)
    image, transmittance, *rest = _Channels.apply(want_absolute_gradient, depths, camera, means2d, features, *scene)
    image = image[:shown]
    background = settings.bg.to(image).reshape(-1)
    if len(background) not in (1, shown):
        raise ValueError(f"the background must have {shown} values, or one for all, got {len(background)}")
    return ChannelImage(image + transmittance * background[:, None, None], transmittance, *rest)


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


def _passes(splats: Tensor, features: Tensor) -> Iterator[tuple[Tensor, int]]:
    """The splats of each pass, and how many channels it shows."""
    first = min(features.shape[1], _PASS - _COLORS)
    if first:
        splats = splats.clone()
        splats[:, SPLAT_VALUES - 1] = features[:, 0]
    yield splats, _COLORS + first
    for begin in range(first, features.shape[1], _PASS):
        group = features[:, begin : begin + _PASS]
        rows = splats.clone()
        rows[:, _SHOWN : _SHOWN + group.shape[1]] = group
        yield rows, group.shape[1]


class _Channels(torch.autograd.Function):
    """Inputs: whether absolute gradients are wanted, depths, the camera's numbers, means2d, features, and `Scene`'s."""

    @staticmethod
    def forward(ctx, absolute, order, camera, means2d, features, *scene):
        with torch._C._AutoDispatchBelowAutograd():
            given = Scene(*scene)
            splats, depths, rects, tile_counts, radii = OPERATORS.project(*given)
            lists = OPERATORS.bin(splats, depths if order is None else order, rects, tile_counts, *given.size, True)
            planes, kept = [], []
            for rows, shown in _passes(splats, features):
                out = OPERATORS.blend(rows, *lists[:2], rows.new_zeros(3), *given.size, shown == _PASS, True)
                color, transmittance, last, inverse_depth = *out[:2], out[3], out[2]
                planes.append(color[:shown] if shown < _PASS else torch.cat([color, inverse_depth]))
                kept.append(out[4])
        ctx.absolute, ctx.numbers, ctx.passes = absolute, scene[11:], len(kept)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*scene[:11], splats, features, tile_counts, *lists, last, transmittance, *kept)
        ctx.mark_non_differentiable(radii, splats, depths, tile_counts)
        return torch.cat(planes), transmittance, radii, splats, depths, tile_counts

    @staticmethod
    @first_order("rasterize_channels")
    def backward(ctx, grad_image, grad_transmittance, *_):
        saved, needed = ctx.saved_tensors, ctx.needs_input_grad
        scene = (*saved[:11], *ctx.numbers)
        splats, features, tile_counts, *lists, last, transmittance = saved[11 : -ctx.passes]
        if grad_image is None:
            grad_image = splats.new_zeros(_COLORS + features.shape[1], *last.shape)
        rows, of_features, place = None, [], 0
        for (one, shown), layers in zip(_passes(splats, features), saved[-ctx.passes :], strict=True):
            kept = one, tile_counts, *lists, last, layers, splats.new_zeros(3), transmittance
            planes = _planes(grad_image[place : place + shown])
            place += shown
            found, counts = OPERATORS.blend_rows(kept, planes[0], grad_transmittance, planes[1], ctx.absolute)
            grad_transmittance = None  # counts once
            begin = SPLAT_VALUES - 1 if rows is None else _SHOWN
            if needed[4] and begin < _SHOWN + shown:
                of_features.append(_sums(found[:, begin : _SHOWN + shown], counts))
            if rows is None:
                rows = found
                rows[:, SPLAT_VALUES - 1] = 0  # of a channel, not of a depth
            else:
                for sums in (slice(_SHOWN), slice(SPLAT_VALUES, None)):  # the last are those of rays
                    rows[:, sums] += found[:, sums]
        source = splats, tile_counts, rows, counts
        results = [None] * len(needed)
        if needed[2]:
            results[2] = OPERATORS.sum_blocks(OPERATORS.camera_vjp(*scene, source, ctx.absolute))
        if of_features:
            results[4] = torch.cat(of_features, 1)
        places = [3, *range(5, 5 + _GAUSSIANS)]
        wanted = [needed[at] for at in places]
        if any(wanted):
            gradients = OPERATORS.rasterize_vjp(*scene, wanted, source, None, None, None, ctx.absolute)
            for at, gradient in zip(places, gradients, strict=True):
                results[at] = gradient if needed[at] else None
        return tuple(results)


def _planes(gradient: Tensor) -> tuple[Tensor, Tensor | None]:
    """The gradients of colour and inverse depth of a pass, from those of its channels."""
    if len(gradient) == _PASS:
        return gradient[:_COLORS].contiguous(), gradient[_COLORS:].contiguous()
    missing = gradient.new_zeros(_COLORS - len(gradient), *gradient.shape[1:])
    return torch.cat([gradient, missing]), None


def _sums(rows: Tensor, counts: Sequence[int]) -> Tensor:
    """The sum of each splat's rows, which lie side by side."""
    return torch.segment_reduce(rows.contiguous(), "sum", lengths=counts.long(), axis=0, unsafe=True)
