"""`rasterize` of diff_gaussian_rasterization over ranks, differentiable."""

from dataclasses import replace
from typing import Any

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings
from diff_gaussian_rasterization.camera import camera_numbers
from diff_gaussian_rasterization.first_order import first_order
from diff_gaussian_rasterization.gaussians import Gaussians
from diff_gaussian_rasterization.ops import Rasterized, gradients_of
from diff_gaussian_rasterization.scene import Scene, scene_arguments
from torch import Tensor

from gaussian_renderer.over_ranks.band import camera_gradient, draw_view, gather_image, gradient_rows
from groundwork.ranks.ranks import Ranks


def rasterize_over(
    ranks: Ranks,
    means: Tensor,
    means2d: Tensor,
    opacities: Tensor,
    settings: GaussianRasterizationSettings,
    *,
    raw: bool = False,
    want_inverse_depth: bool = False,
    want_absolute_gradient: bool = False,
    **others: Tensor | None,
) -> Rasterized:
    """Render the Gaussians of all ranks. Arguments as for `rasterize`, each rank with its own Gaussians.

    Every rank calls this function for the same view and gets the whole image, and `radii` of its own Gaussians;
    backward needs the same gradient of the image on every rank. Tensors of the settings get gradients if they require
    them on every rank.
    """
    gaussians = Gaussians(means, opacities, **others)
    scene = scene_arguments(gaussians, settings, raw)
    numbers = camera_numbers(scene, settings)
    trained = any(x is not None and x.requires_grad for x in (*gaussians, means2d, numbers))
    train = torch.is_grad_enabled() and trained
    options = scene.camera, settings.bg, want_inverse_depth, train, want_absolute_gradient
    color, depth, radii = _OverRanks.apply(ranks, options, numbers, means2d, *gaussians)
    return Rasterized(color, radii, depth if want_inverse_depth else None, None)


class _OverRanks(torch.autograd.Function):
    """Autograd of `rasterize_over`. Inputs: ranks, constants, the camera's numbers or None, means2d, the Gaussians."""

    @staticmethod
    def forward(
        ctx: Any, ranks: Ranks, options: tuple, numbers: Tensor | None, _: Tensor, *gaussians: Any
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Draw the view of all processes' Gaussians, and keep what `backward` needs if the model is trained."""
        camera, background, want_depth, train, absolute = options
        view = gather_image(draw_view(ranks, Scene(*gaussians, *camera), background, want_depth, train))
        ctx.mark_non_differentiable(view.radii)
        ctx.set_materialize_grads(False)
        if train:
            # An output refers to ctx by its history. Kept here, it would be a cycle that nothing frees.
            kept = {name: getattr(view, name).detach() for name in ("color", "inverse_depth", "radii")}
            drawing = view.drawing._replace(**kept)
            ctx.view = replace(view, drawing=drawing, **kept)
            ctx.want_depth, ctx.absolute, ctx.camera = want_depth, absolute, camera
            ctx.save_for_backward(*gaussians)
        return view.color, view.inverse_depth, view.radii

    @staticmethod
    @first_order("rasterize")
    def backward(ctx: Any, grad_color: Tensor | None, grad_depth: Tensor | None, _: None) -> tuple:
        """Return the gradients of `forward`'s arguments, of this process's Gaussians, from those of image and depth."""
        scene, view = Scene(*ctx.saved_tensors, *ctx.camera), ctx.view
        if grad_color is None:
            grad_color = torch.zeros_like(view.color)
        gradients = grad_color, None, grad_depth if ctx.want_depth else None
        source = view.splats, view.tile_counts, *gradient_rows(view, gradients, ctx.absolute)
        of_camera = camera_gradient(view.ranks, scene, source, ctx.absolute) if ctx.needs_input_grad[2] else None
        return None, None, of_camera, *gradients_of(scene, source, (), ctx.needs_input_grad[3:], ctx.absolute)
