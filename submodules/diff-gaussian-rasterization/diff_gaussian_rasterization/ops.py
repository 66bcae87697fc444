"""The rasterizer as Python functions: named arguments and results, autograd. The operators check their inputs."""

from typing import NamedTuple

import torch
from torch import Tensor, library

import diff_gaussian_rasterization.fakes  # noqa: F401  (registers the fake kernels)
from diff_gaussian_rasterization.backend import OPERATORS
from diff_gaussian_rasterization.checks import check_finite, check_flags, check_tensors
from diff_gaussian_rasterization.first_order import direct_apply, first_order, function_of, is_compiled, needs_function
from diff_gaussian_rasterization.gaussians import Gaussians, lists_gaussians
from diff_gaussian_rasterization.schema import GRADIENT_PLACES, INPUTS, SCENE_TENSORS
from diff_gaussian_rasterization.settings import GaussianRasterizationSettings

_FLAGS = ("prefiltered", "debug", "antialiasing", "inverse_depth")
_OPACITIES = INPUTS.index("opacities")


class Rasterized(NamedTuple):
    """The result of `rasterize`."""

    color: Tensor  # (3, H, W), background included
    radii: Tensor  # (N,) int32, px: ceil of 3 sigma, 0 where culled
    inverse_depth: Tensor | None  # (1, H, W): sum of alpha T / z, no background, not normalised
    transmittance: Tensor | None  # (1, H, W): what is left for the background


@lists_gaussians
def rasterize(
    means: Tensor,
    means2d: Tensor,
    opacities: Tensor,
    settings: GaussianRasterizationSettings,
    *,
    raw: bool = False,
    want_inverse_depth: bool = False,
    want_transmittance: bool = False,
    want_absolute_gradient: bool = False,
    **others: Tensor | None,
) -> Rasterized:
    """Renders Gaussians (Kerbl et al. 2023, sections 4 and 6); differentiable in every tensor but the settings'.

    means, opacities and others: the fields of `Gaussians`, which has their shapes; all float32 or all float64.
    means2d (N, 3): values unused; receives d loss / d mean on the image, per NDC unit, in x and y. The third value is
    0, or with want_absolute_gradient the length of the absolute gradient (Ye et al. 2024, AbsGS), per NDC unit:
    sqrt((sum |dL_p/dx|)^2 + (sum |dL_p/dy|)^2) over the pixels p, dL_p what p alone makes of the loss.
    raw: opacities are logits, scales are logarithms, and rotations have any length (zero means the identity).
    Gaussians with a NaN or an infinite value, or with an opacity of 0 or less, are left out and receive zero gradients.
    The view matrix is taken as it is: scaled, sheared and mirrored ones give the image of that linear map.
    Second derivatives and derivatives in forward mode raise RuntimeError. Raises TypeError for None, other wrong types
    and dtypes, and ValueError for wrong shapes, degrees and tangents. Raises RuntimeError for wrong sizes, and if the
    image needs more than 2^31 tile instances.
    """
    gaussians = Gaussians(means, opacities, **others)
    try:
        arguments = scene_arguments(gaussians, settings, raw)
        train = needs_function(*gaussians, means2d)
        if settings.debug:
            for name, values in gaussians._asdict().items():
                if values is not None:
                    check_finite(name, values)
        # torch.compile knows the operator, whose autograd is registered below.
        function = _apply if train and not is_compiled() else OPERATORS.rasterize
        out = function(means2d, *arguments, settings.bg, want_inverse_depth, train, want_absolute_gradient)
    except (AttributeError, TypeError, RuntimeError):
        _check_types(gaussians, settings, means2d)
        raise
    color, transmittance, inverse_depth, radii = out[:4]
    if settings.debug:
        check_finite("the rendered image", color)
        if train:
            _check_gradients(gaussians._asdict() | {"means2d": means2d})
    return Rasterized(
        color, radii, inverse_depth if want_inverse_depth else None, transmittance if want_transmittance else None
    )


@lists_gaussians
@torch.no_grad()
def decisive(
    means: Tensor,
    opacities: Tensor,
    settings: GaussianRasterizationSettings,
    *,
    raw: bool = False,
    **others: Tensor | None,
) -> Tensor:
    """Finds the decisive Gaussians, those that the image of `rasterize` depends on: (N,) bool. Same arguments.

    A decisive Gaussian is blended in some pixel, or ends one. It ends a pixel if it would leave less than 1e-4 of
    the transmittance: the pixel takes neither it nor any Gaussian behind it. Without the others the image keeps every
    bit, or on a GPU, in images of up to 3,000 tiles, changes by rounding where a pixel blends deep in a long list.
    """
    gaussians = Gaussians(means, opacities, **others)
    try:
        out = OPERATORS.rasterize(means, *scene_arguments(gaussians, settings, raw), settings.bg, False, True)
    except RuntimeError:
        _check_types(gaussians, settings)
        raise
    _, _, _, _, splats, _, instances, ranges, _, _, last, _ = out
    return OPERATORS.decisive(splats, instances, ranges, last)


def mark_visible(positions: Tensor, view: Tensor) -> Tensor:
    """Marks positions (N, 3) whose z is above 0.2 in the view (4, 4, transposed): (N,) bool."""
    return OPERATORS.mark_visible(positions, view)


def scene_arguments(gaussians: Gaussians, settings: GaussianRasterizationSettings, raw: bool) -> tuple:
    """Puts Gaussians and camera into the order of the operators' arguments (`schema.SCENE`)."""
    check_flags({name: getattr(settings, name) for name in _FLAGS})  # the text "no" would count as True
    center = settings.campos  # (3,); code of 2023 also gives a row (1, 3)
    return (
        *gaussians,
        settings.viewmatrix,
        settings.projmatrix,
        center if center.dim() == 1 else center.reshape(-1),
        settings.tanfovx,
        settings.tanfovy,
        settings.image_height,
        settings.image_width,
        settings.sh_degree,
        settings.scale_modifier,
        bool(settings.antialiasing),
        raw,
    )


def _check_types(gaussians: Gaussians, settings: GaussianRasterizationSettings, means2d: object = None) -> None:
    """Finds the input that is no tensor after a call has failed, since the call's own message may not name it."""
    camera = {name: getattr(settings, name) for name in ("viewmatrix", "projmatrix", "campos", "bg")}
    check_tensors(gaussians._asdict() | {"means2d": means2d} | camera)


def _check_gradients(inputs: dict[str, Tensor | None]) -> None:
    """Lets the backward check the gradient of each input that receives one."""
    for name, values in inputs.items():
        if values is not None and values.requires_grad:
            values.register_hook(lambda gradient, name=name: check_finite(f"the gradient of {name}", gradient))


def _setup_context(ctx, inputs, output):
    ctx.mark_non_differentiable(*output[3:])
    _keep(ctx, inputs, output)


def _keep(ctx, inputs, output):
    """Keep what the backward needs of the operator's inputs and output."""
    *inputs, absolute = (*inputs, False)[: len(INPUTS)]  # the dispatcher leaves a default out
    _, *scene, background, inverse_depth, train = inputs
    _, transmittance, _, _, splats, tile_counts, instances, ranges, splat_slots, slots, last, layers = output
    ctx.set_materialize_grads(False)
    ctx.numbers, ctx.inverse_depth, ctx.train, ctx.absolute = scene[SCENE_TENSORS:], inverse_depth, train, absolute
    state = (splats, instances, ranges, splat_slots, slots, background, last, transmittance)
    ctx.save_for_backward(*scene[:SCENE_TENSORS], *state, tile_counts, layers)


@first_order("rasterize")
def _backward(ctx, grad_color, grad_transmittance, grad_inverse_depth, *_):
    if not ctx.train:
        raise RuntimeError("this image was rasterized with train=False, so it has no backward")
    saved = ctx.saved_tensors
    scene, state, more = (*saved[:SCENE_TENSORS], *ctx.numbers), saved[SCENE_TENSORS:-2], saved[-2:]
    wanted = [ctx.needs_input_grad[place] for place in GRADIENT_PLACES]
    if grad_color is None:
        grad_color = state[-1].new_zeros(3, *state[-1].shape[1:])
    if not ctx.inverse_depth:
        grad_inverse_depth = None
    image = grad_color, grad_transmittance, grad_inverse_depth
    gradients = OPERATORS.rasterize_vjp(*scene, *state, *image, *more, wanted, ctx.absolute)
    by_input = [None] * len(INPUTS)
    for place, gradient, is_wanted in zip(GRADIENT_PLACES, gradients, wanted, strict=True):
        if is_wanted:
            by_input[place] = gradient
    shape = scene[_OPACITIES - 1].shape  # `scene` lacks means2d, the first input
    if (gradient := by_input[_OPACITIES]) is not None and gradient.shape != shape:
        by_input[_OPACITIES] = gradient.reshape(shape)  # a caller may have given a row instead of a column
    return tuple(by_input)


# For callers of the operator itself, and for torch.compile.
library.register_autograd("diff_gaussian_rasterization::rasterize", _backward, setup_context=_setup_context)


class _Rasterize(torch.autograd.Function):
    """The same, with no more outputs than callers see."""

    @staticmethod
    def forward(ctx, *inputs):
        with torch._C._AutoDispatchBelowAutograd():
            output = OPERATORS.rasterize(*inputs)
        _keep(ctx, inputs, output)
        ctx.mark_non_differentiable(output[3])
        return output[:4]

    backward = staticmethod(_backward)


_apply = direct_apply(_Rasterize, function_of(OPERATORS.rasterize, _setup_context, _backward))
