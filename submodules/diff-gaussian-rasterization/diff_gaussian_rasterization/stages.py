"""Blending in two stages, each a function of autograd: projection, then an image of channels.

The gradient of `splats` is moments (csrc/math/footprint.h) in place of gradients of their values, from which projection
makes gradients without loss. An optional stage between the two describes splats: it turns them into the means, conics
and opacities that programs of gsplat know (gsplat/description.py). Then blending sends the moments to that stage, and
beside them the gradients of means, conics and opacities, so that hooks see them.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function

from diff_gaussian_rasterization.backend import OPERATORS
from diff_gaussian_rasterization.first_order import direct_apply, first_order

_TENSORS = 11  # of a Scene, which come first
_ROW_Z, _SHIFT_Z = slice(6, 9), 11  # of the camera's numbers (camera.py)


class Blending(NamedTuple):
    """Options of the blending of alphas, and further results that are wanted."""

    size: tuple[int, int]  # height, width
    cap: float  # the largest alpha
    stops: bool  # whether gradients end there
    colored: bool = False  # whether colours come before the features
    absolute: bool = False  # whether absolute gradients are wanted
    channels_last: bool = False  # images (1, H, W, C) and alphas (1, H, W, 1), else (C, H, W) and transmittance


class Shared:
    """Messages that an image's stages exchange during a backward pass.

    The stages are projection, blending and, between them, the optional description of splats (gsplat/description.py).

    lengths: absolute gradients of means on the image (N,); blending writes, projection reads.
    shown: (N,) int32, not 0 for rows that may have a gradient, by the image or by a loss of the described values; the
        description writes, projection takes it in place of tile_counts and clears it. None: tile_counts tell.
    use_lengths: function that gets `lengths`; gsplat's function sets, blending calls.
    describe_moments: function that turns moments into gradients of means2d, conics and opacities, from splats,
        tile_counts, moments and rows; the description sets, blending calls.
    hooks: functions that return the hooks of a described tensor, None once it is gone; gsplat's function sets, the
        description asks if there are any.

    The last three are of `send` and `take`; blending writes, the description reads and clears:

    task: number of autograd's backward pass that has sent moments.
    moments: the moments (N, values).
    sent: address and version of each gradient that went with them, by which changed gradients are found.
    """

    __slots__ = ("describe_moments", "hooks", "lengths", "moments", "sent", "shown", "task", "use_lengths")

    def __init__(self) -> None:
        """Begin without a message."""
        self.lengths: Tensor | None = None
        self.shown: Tensor | None = None
        self.use_lengths: Callable[[Tensor], None] | None = None
        self.describe_moments: Callable[..., Sequence[Tensor]] | None = None
        self.hooks: list[Callable[[], dict | None]] = []
        self.task = self.moments = self.sent = None

    def send(self, moments: Tensor, gradients: Sequence[Tensor]) -> None:
        """Keep the moments of this backward pass, and marks by which the description recognises their gradients.

        gradients: of means2d, conics and opacities, as blending returns them to autograd.
        """
        self.task, self.moments = torch._C._current_graph_task_id(), moments
        self.sent = [(values.data_ptr(), values._version) for values in gradients]

    def take(self) -> tuple[Tensor | None, list]:
        """Return the moments that were sent in this backward pass, and the marks of their gradients; else None, []."""
        now = self.task is not None and self.task == torch._C._current_graph_task_id()
        found = (self.moments, self.sent) if now else (None, [])
        self.task = self.moments = self.sent = None
        return found


class _Projected(Function):
    """The first stage: projects Gaussians, and makes their lists.

    Inputs: `Shared`, True if a backward follows (None: no lists), the camera's numbers, means2d, the fields of `Scene`.
    Results: splats, depths, tile_counts, radii, then the lists of the operator `bin`, or the rects that it takes.
    """

    @staticmethod
    def forward(
        ctx: Any, shared: Shared, train: bool | None, camera: Tensor | None, means2d: Tensor | None, *scene: Any
    ) -> tuple:
        """Project the Gaussians, and make lists of the splats of each tile, unless `train` is None."""
        with torch._C._AutoDispatchBelowAutograd():
            if train is None:
                splats, depths, rects, *counts = OPERATORS.project(*scene)
                others = *counts, rects
            else:
                splats, depths, *others = OPERATORS.project_binned(*scene, train)
        ctx.shared, ctx.numbers = shared, scene[_TENSORS:]
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*scene[:_TENSORS], splats, others[0])
        ctx.mark_non_differentiable(*others)
        return splats, depths, *others

    @staticmethod
    @first_order("rasterize_channels")
    def backward(ctx: Any, moments: Tensor | None, of_depth: Tensor | None, *_: Any) -> tuple:
        """Return the gradients of camera, means2d and Gaussians, made of moments and gradients of depths.

        moments: (N, values), of the splats; None: zeros.
        of_depth: gradient of the depths (N,), or None.
        """
        needed, saved = ctx.needs_input_grad, ctx.saved_tensors
        results, scene = [None] * len(needed), (*saved[:_TENSORS], *ctx.numbers)
        splats, tile_counts = saved[_TENSORS:]
        if ctx.shared.shown is not None:
            tile_counts, ctx.shared.shown = ctx.shared.shown, None
            if splats.is_cuda and scene[6] is not None:  # whose kernels look at the SH of those with a tile alone
                read = (scene[12][2] + 1) ** 2 - 1
                sums = scene[6].sum((1, 2)) + scene[7][:, :read].sum((1, 2))
                tile_counts = torch.where(sums.isfinite(), tile_counts, 0)
        source = splats, tile_counts, torch.zeros_like(splats) if moments is None else moments
        means, to_view = scene[0], scene[8].to(splats)[:3, 2]
        if needed[2]:
            results[2] = OPERATORS.sum_blocks(OPERATORS.camera_vjp(*scene, source))
            if of_depth is not None:
                results[2][_ROW_Z] += of_depth @ means
                results[2][_SHIFT_Z] += of_depth.sum()
        wanted = needed[3 : 4 + 8]
        if any(wanted):
            found = OPERATORS.rasterize_vjp(*scene, wanted, source)
            results[3 : 4 + 8] = [gradient if want else None for gradient, want in zip(found, wanted, strict=True)]
            if wanted[0] and ctx.shared.lengths is not None:
                results[3][:, 2] = ctx.shared.lengths
            if wanted[1] and of_depth is not None:
                results[4].addr_(of_depth, to_view)
        return tuple(results)


class _Blended(Function):
    """The second stage: blends splats into an image.

    Channels are colours, features, then depths, if they are described. They are blended in the order of `order`.

    Inputs: `Shared`, `Blending`, True if a backward follows, order (N,), the lists or rects, tile_counts, rows that are
        shown or None, splats, then means2d, conics, opacities and depths as described, or None, features (N, F) or
        None, and the background.
    Results: image and transmittance or alpha, and the lists: instances and ranges.
    """

    @staticmethod
    def forward(
        ctx: Any, shared: Shared, how: Blending, train: bool, order: Tensor, lists: Sequence[Tensor],
        tile_counts: Tensor, rows: Tensor | None, splats: Tensor, means2d: Tensor | None, conics: Tensor | None,
        opacities: Tensor | None, depths: Tensor | None, features: Tensor | None, background: Tensor,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        """Blend the channels of the splats, and keep what the backward needs."""
        with torch._C._AutoDispatchBelowAutograd():
            if len(lists) == 1:
                lists = OPERATORS.bin(splats, order, *lists, tile_counts, *how.size, train)
            parts = [splats[:, 6:9]] if how.colored else []
            parts += [part for part in (features, None if depths is None else order[:, None]) if part is not None]
            values = parts[0] if len(parts) == 1 else torch.cat(parts, 1)
            behind = background.expand(values.shape[1])
            image, transmittance, last, alpha = OPERATORS.blend_channels(
                splats, values, *lists[:2], behind, *how.size, how.cap, how.channels_last
            )
            kept = splats, tile_counts, *lists, last, splats.new_empty(0), behind, transmittance
            alpha = alpha if how.channels_last else transmittance
        ctx.shared, ctx.how, ctx.background = shared, how, background.shape
        ctx.widths = 3 * how.colored, 0 if features is None else features.shape[1]
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(rows, values, *kept)
        ctx.mark_non_differentiable(*lists[:2])
        return image, alpha, *lists[:2]

    @staticmethod
    @first_order("rasterize_channels")
    def backward(ctx: Any, of_image: Tensor | None, of_alpha: Tensor | None, *_: Any) -> tuple:
        """Return the moments or, if splats are described, the gradients of their description; and those of features.

        of_image, of_alpha: gradients of the two results, in their shapes; None: zeros.
        """
        (rows, values, *kept), how, needed = ctx.saved_tensors, ctx.how, ctx.needs_input_grad
        splats, tile_counts, transmittance, shared = kept[0], kept[1], kept[9], ctx.shared
        last = how.channels_last
        if of_image is None:
            of_image, last = splats.new_zeros(values.shape[1], *how.size), False
        elif last and not of_image.is_contiguous():
            of_image, last = of_image[0].permute(2, 0, 1), False  # the order that it most likely has
        if how.channels_last and of_alpha is not None:
            of_alpha = -of_alpha[..., 0]
        results = [None] * len(needed)
        moments, lengths, of_values = OPERATORS.channel_moments(
            kept, values, of_image, of_alpha, how.cap, how.stops, how.absolute, needed[11] or needed[12], last
        )
        if how.absolute:
            shared.lengths = lengths
            if shared.use_lengths:
                shared.use_lengths(lengths)
        if needed[8]:
            screen = shared.describe_moments(splats, tile_counts, moments, rows)
            shared.send(moments, screen)
            results[8:11] = screen
        else:
            results[7] = moments
        first, count = ctx.widths
        if needed[11]:
            results[11] = _select_rows(of_values[:, -1], rows)
        if needed[12]:
            results[12] = of_values if of_values.shape[1] == count else of_values[:, first : first + count]
        if needed[13]:
            planes = of_image[0].permute(2, 0, 1) if last else of_image
            results[13] = torch.mv(planes.flatten(1), transmittance.flatten()).sum_to_size(ctx.background)
        return tuple(results)


def _select_rows(values: Tensor, rows: Tensor | None) -> Tensor:
    return values[None] if rows is None else values[rows]


projected, blended = map(direct_apply, (_Projected, _Blended))
