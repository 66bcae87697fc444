"""Rendering of as many views as there are ranks, each by one rank, with the Gaussians of all ranks; differentiable."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from diff_gaussian_rasterization import GaussianRasterizationSettings
from diff_gaussian_rasterization.backend import OPERATORS
from diff_gaussian_rasterization.first_order import first_order
from diff_gaussian_rasterization.gaussians import Gaussians
from diff_gaussian_rasterization.scene import GRADIENTS, Drawing, Scene, scene_arguments
from torch import Tensor

from splatting.distributed.ranks import Ranks
from splatting.distributed.rendering.exchange import return_sums, send_views


class Rendered(NamedTuple):
    """The rank's view, and what all views say of its own Gaussians."""

    color: Tensor  # (3, H, W)
    inverse_depth: Tensor | None  # (1, H, W)
    radii: Tensor  # (views, N) int32, pixels


def rasterize_views(
    ranks: Ranks,
    gaussians: Gaussians,
    means2d: Tensor,
    settings: Sequence[GaussianRasterizationSettings],
    numbers: Tensor,
    *,
    raw: bool,
    want_inverse_depth: bool,
    want_absolute_gradient: bool,
) -> Rendered:
    """Render view r on rank r. settings: of all views, on every rank; gaussians: the rank's own.

    means2d: (views, N, 3), whose gradient is that of the screen means in each view. numbers: (views, CAMERA_NUMBERS)
    float64, whose gradient, if wanted, is that of the numbers of each view's camera, on every rank. Backward gives each
    rank's own Gaussians the sum of the gradients of all views; every rank has to call it.
    """
    cameras = [scene_arguments(gaussians, view, raw).camera for view in settings]
    wants = want_inverse_depth, want_absolute_gradient
    background = settings[ranks.rank].bg
    color, depth, radii = _Views.apply(ranks, cameras, background, wants, numbers, means2d, *gaussians)
    return Rendered(color, depth if want_inverse_depth else None, radii)


class _Views(torch.autograd.Function):
    """Takes what is no tensor, the background, the cameras' numbers, means2d, and the Gaussians."""

    @staticmethod
    def forward(
        ctx: Any,
        ranks: Ranks,
        cameras: list[tuple],
        background: Tensor,
        wants: tuple[bool, bool],
        numbers: Tensor,
        _: Tensor,
        *gaussians: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        projected = [OPERATORS.project(*gaussians, *camera) for camera in cameras]
        (splats, depths, rects, counts), sent = send_views(ranks, [tensors[:4] for tensors in projected])
        height, width = Scene(*gaussians, *cameras[ranks.rank]).size
        lists = OPERATORS.bin(splats, depths, rects, counts, height, width, True)
        planes = OPERATORS.blend(splats, *lists[:2], background, height, width, wants[0], True)
        color, transmittance, inverse_depth, last, layers = planes
        radii = torch.stack([radii for *_, radii in projected])
        ctx.mark_non_differentiable(radii)
        ctx.set_materialize_grads(False)
        ctx.ranks, ctx.cameras, ctx.wants, ctx.sent = ranks, cameras, wants, sent
        ctx.numbers = numbers.shape[1]
        ctx.own = [(own, tile_counts) for own, _, _, tile_counts, _ in projected]
        drawn = Drawing(
            color.detach(), transmittance, inverse_depth.detach(), radii, splats, counts, *lists, last, layers
        )
        ctx.kept = drawn.kept(background)
        ctx.save_for_backward(*gaussians)
        return color, inverse_depth, radii

    @staticmethod
    @first_order("rasterize")
    def backward(ctx: Any, grad_color: Tensor | None, grad_depth: Tensor | None, _: None) -> tuple:
        want_depth, absolute = ctx.wants
        if grad_color is None:
            grad_color = ctx.kept[-1].new_zeros(3, *ctx.kept[-1].shape[1:])
        planes = grad_color, None, grad_depth if want_depth else None
        rows, counts = OPERATORS.blend_rows(ctx.kept, *planes, absolute)
        gaussians = ctx.saved_tensors
        needed = dict(zip(Gaussians._fields, ctx.needs_input_grad[6:], strict=True), means2d=ctx.needs_input_grad[5])
        wanted = [needed[name] for name in GRADIENTS]
        count = len(gaussians[0])
        screen = gaussians[0].new_zeros(ctx.ranks.size, count if needed["means2d"] else 0, 3)
        of_cameras = []  # what blocks of the rank's rows add to the numbers of each
        for view, (own, own_counts) in enumerate(return_sums(ctx.ranks, ctx.sent, count, rows, counts)):
            scene, source = Scene(*gaussians, *ctx.cameras[view]), (*ctx.own[view], own, own_counts)
            if ctx.needs_input_grad[4]:
                found = OPERATORS.camera_vjp(*scene, source, absolute)
                of_cameras.append(F.pad(found, (0, ctx.numbers - found.shape[1])))
            if view == 0:
                sums = dict(
                    zip(GRADIENTS, OPERATORS.rasterize_vjp(*scene, wanted, source, absolute=absolute), strict=True)
                )
                screen[0] = sums["means2d"]
            else:
                sums["means2d"] = screen[view]
                OPERATORS.apply_gradients_(
                    *scene.lists, source, [], list(sums.values()), None, *[[]] * 4, absolute=absolute
                )
        of_inputs = [sums[name] if needed[name] else None for name in Gaussians._fields]
        numbers = None
        if of_cameras:
            numbers = OPERATORS.sum_blocks(ctx.ranks.gather(torch.cat(of_cameras, 1))).view(ctx.ranks.size, -1)
        return None, None, None, None, numbers, screen if needed["means2d"] else None, *of_inputs
