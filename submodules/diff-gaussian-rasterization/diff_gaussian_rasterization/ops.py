"""The rasterizer as Python functions: named arguments and results, autograd. The operators check their inputs."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, library
from torch.utils._pytree import tree_flatten, tree_leaves, tree_unflatten

import diff_gaussian_rasterization.fakes  # noqa: F401  (registers the fake kernels)
from diff_gaussian_rasterization.alternatives import shaped
from diff_gaussian_rasterization.backend import OPERATORS, has_kernels
from diff_gaussian_rasterization.camera import camera_numbers
from diff_gaussian_rasterization.checks import check_finite, check_tensors
from diff_gaussian_rasterization.first_order import direct_apply, first_order, function_of, is_compiled, needs_function
from diff_gaussian_rasterization.gaussians import Gaussians, lists_gaussians
from diff_gaussian_rasterization.scene import Drawing, draw, scene_arguments
from diff_gaussian_rasterization.settings import GaussianRasterizationSettings

_NEAR = 0.2  # kUsualNear in csrc/data.h
_DIFFERENTIABLE = ("viewmatrix", "projmatrix", "campos", "lens_values")  # of the settings
_CAMERA = 19  # place of the camera's numbers among the operator's inputs


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
    """Renders Gaussians (Kerbl et al. 2023, sections 4 and 6); differentiable in every tensor but the background.

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
        scene = scene_arguments(gaussians, settings, raw)
        camera = camera_numbers(scene, settings)
        train = camera is not None or needs_function(*gaussians, means2d)
        if settings.debug:
            for name, values in gaussians._asdict().items():
                if values is not None:
                    check_finite(name, values)
        # torch.compile knows the operator, whose autograd is registered below.
        function = _apply if train and not is_compiled() else OPERATORS.rasterize
        further = () if camera is None else (None, camera)
        planes = want_inverse_depth, train, want_absolute_gradient
        out = function(means2d, *scene, shaped(settings.bg, 3), *planes, *further)
    except (AttributeError, TypeError, RuntimeError):
        _check_types(gaussians, settings, means2d)
        raise
    color, transmittance, inverse_depth, radii = out[:4]
    if settings.debug:
        check_finite("the rendered image", color)
        if train:
            camera = {name: getattr(settings, name) for name in _DIFFERENTIABLE}
            _check_gradients(gaussians._asdict() | {"means2d": means2d} | camera)
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
        scene = scene_arguments(gaussians, settings, raw)
        drawn = draw(scene, settings.bg)
    except RuntimeError:
        _check_types(gaussians, settings)
        raise
    return OPERATORS.decisive(drawn.splats, drawn.instances, drawn.ranges, drawn.last, scene.lens)


def mark_visible(positions: Tensor, view: Tensor) -> Tensor:
    """Marks positions (N, 3) whose z is above 0.2 in the view (4, 4, transposed): (N,) bool."""
    for name, values, shape in (("positions", positions, (len(positions), 3)), ("the view matrix", view, (4, 4))):
        if values.shape != shape:
            raise ValueError(f"{name} must be {shape}, got {tuple(values.shape)}")
    matrix, (x, y, z) = view.to(positions), positions.unbind(1)
    return x * matrix[0, 2] + y * matrix[1, 2] + z * matrix[2, 2] + matrix[3, 2] > _NEAR


def has_cuda_kernels() -> bool:
    """Tell whether this build has the CUDA backend. A GPU may be missing even so: see torch.cuda.is_available()."""
    return has_kernels("rasterize", "cuda")


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
    _, *tensors, lens, options, background, inverse_depth, train, absolute = inputs[:18]
    ctx.set_materialize_grads(False)
    ctx.numbers, ctx.inverse_depth, ctx.train, ctx.absolute = (lens, options), inverse_depth, train, absolute
    ctx.save_for_backward(*tensors, *Drawing.kept(output, background))


@first_order("rasterize")
def _backward(ctx, grad_color, grad_transmittance, grad_inverse_depth, *_):
    """Return the gradients of the operator's inputs, None for those that are not needed."""
    if not ctx.train:
        raise RuntimeError("this image was rasterized with train=False, so it has no backward")
    saved, needed = ctx.saved_tensors, list(ctx.needs_input_grad)
    scene, kept = (*saved[:11], *ctx.numbers), saved[11:]
    if grad_color is None:
        grad_color = kept[-1].new_zeros(3, *kept[-1].shape[1:])
    planes = grad_color, grad_transmittance, grad_inverse_depth if ctx.inverse_depth else None
    results = [None] * len(needed)
    if any(needed[_CAMERA:]):  # both backwards take the rows that the blending's makes once
        kept, planes = (*kept[:2], *OPERATORS.blend_rows(kept, *planes, ctx.absolute)), ()
        results[_CAMERA] = OPERATORS.sum_blocks(OPERATORS.camera_vjp(*scene, kept, ctx.absolute))
    if planes or any(needed[:9]):
        results[:9] = gradients_of(scene, kept, planes, needed[:9], ctx.absolute)
    return tuple(results)


def gradients_of(
    scene: Sequence,
    source: Sequence[Tensor],
    planes: Sequence[Tensor | None],
    needed: Sequence[bool],
    absolute: bool = False,
) -> list[Tensor | None]:
    """Gradients of means2d and of each of the Gaussians' tensors, as far as they are needed, else None.

    scene: `Scene`. source, planes: what a forward has kept (`Drawing.kept`), and the gradients of its colour,
    transmittance and inverse depth; or splats, tile_counts, gradient rows and their counts, and nothing.
    """
    results = OPERATORS.rasterize_vjp(*scene, needed, source, *(planes or (None, None, None)), absolute)
    return [gradient if is_needed else None for gradient, is_needed in zip(results, needed, strict=True)]


# For callers of the operator itself, and for torch.compile.
library.register_autograd("diff_gaussian_rasterization::rasterize", _backward, setup_context=_setup_context)


@library.register_vmap("diff_gaussian_rasterization::rasterize_vjp")
def _vjp_of_each(info, in_dims, *arguments):
    """Compute item by item, because torch's own rule does not know lists of tensors."""
    flat, form = tree_flatten(arguments)
    dims = tree_leaves(in_dims)
    found = []
    for item in range(info.batch_size):
        own = [value if dim is None else value.select(dim, item) for value, dim in zip(flat, dims, strict=True)]
        found.append(OPERATORS.rasterize_vjp(*tree_unflatten(own, form)))
    return tuple(map(torch.stack, zip(*found, strict=True))), (0,) * len(found[0])


class _Rasterize(torch.autograd.Function):
    """The operator `rasterize` with no more outputs than callers see."""

    @staticmethod
    def forward(ctx, *inputs):
        """Rasterize, keep what the backward needs, and return color, transmittance, inverse depth and radii."""
        with torch._C._AutoDispatchBelowAutograd():
            output = OPERATORS.rasterize(*inputs)
        _keep(ctx, inputs, output)
        ctx.mark_non_differentiable(output[3])
        return output[:4]

    backward = staticmethod(_backward)


_apply = direct_apply(_Rasterize, function_of(OPERATORS.rasterize, _setup_context, _backward))
