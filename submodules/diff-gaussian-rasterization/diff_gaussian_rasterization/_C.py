"""The functions of the reference's compiled module, for code that calls them itself.

Arguments go by place, in the order of the 2024 release. An empty tensor stands for one that is not given. `debug` and
`prefiltered` have no effect.
"""

import math
from collections.abc import Iterable

import torch
from torch import Tensor

from diff_gaussian_rasterization.alternatives import chosen, given, shaped
from diff_gaussian_rasterization.fakes import SPLAT_VALUES, TILE
from diff_gaussian_rasterization.gaussians import Gaussians
from diff_gaussian_rasterization.ops import gradients_of
from diff_gaussian_rasterization.ops import mark_visible as mark
from diff_gaussian_rasterization.optim import sparse_adam_
from diff_gaussian_rasterization.scene import Scene, camera_arguments, draw

__all__ = ["adamUpdate", "mark_visible", "rasterize_gaussians", "rasterize_gaussians_backward"]


@torch.no_grad()
def mark_visible(positions: Tensor, viewmatrix: Tensor, projmatrix: Tensor) -> Tensor:
    """Marks positions (N, 3) whose z in the view (4, 4, transposed) is above 0.2: (N,) bool. projmatrix is not read."""
    return mark(positions, shaped(viewmatrix, 4, 4))


@torch.no_grad()
def rasterize_gaussians(
    background: Tensor,
    means3D: Tensor,
    colors: Tensor,
    opacity: Tensor,
    scales: Tensor,
    rotations: Tensor,
    scale_modifier: float,
    cov3D_precomp: Tensor,
    viewmatrix: Tensor,
    projmatrix: Tensor,
    tan_fovx: float,
    tan_fovy: float,
    image_height: int,
    image_width: int,
    sh: Tensor,
    degree: int,
    campos: Tensor,
    prefiltered: bool,
    antialiasing: bool,
    debug: bool | None = None,
) -> tuple:
    """Renders activated Gaussians; inputs are those of `GaussianRasterizer`.

    Returns the number of tile instances, colour (3, H, W), radii (N,) int32, three buffers of bytes for
    `rasterize_gaussians_backward`, and the inverse depth (1, H, W). Called as in 2023, where the last argument but one
    is `prefiltered`, it returns no inverse depth.
    """
    of_2023 = debug is None
    gaussians = chosen(means3D, opacity, scales, rotations, cov3D_precomp, colors, sh)
    place, lens = (viewmatrix, projmatrix, campos), (tan_fovx, tan_fovy, scale_modifier)
    options = image_height, image_width, degree, not of_2023 and antialiasing, False
    out = draw(Scene(*gaussians, *camera_arguments(*place, lens, *options)), background, True)
    buffers = (
        _pack(out.splat_slots, out.splats, out.tile_counts),
        _pack(out.instances),
        _pack(out.ranges, out.transmittance, out.last),
    )
    rendered = len(out.instances), out.color, out.radii, *buffers
    return rendered if of_2023 else (*rendered, out.inverse_depth)


@torch.no_grad()
def rasterize_gaussians_backward(
    background: Tensor,
    means3D: Tensor,
    radii: Tensor,
    colors: Tensor,
    opacities: Tensor,
    scales: Tensor,
    rotations: Tensor,
    scale_modifier: float,
    cov3D_precomp: Tensor,
    viewmatrix: Tensor,
    projmatrix: Tensor,
    tan_fovx: float,
    tan_fovy: float,
    grad_out_color: Tensor,
    grad_out_invdepth: Tensor,
    sh: Tensor,
    degree: int,
    campos: Tensor,
    geomBuffer: Tensor,
    num_rendered: int,
    binningBuffer: Tensor,
    imgBuffer: Tensor,
    antialiasing: bool,
    debug: bool,
) -> tuple[Tensor, ...]:
    """Gradients of a rendering of `rasterize_gaussians`, given the gradients of its colour and inverse depth.

    Returns those of the means on the image (N, 3), per NDC unit, then of colors, opacities, means3D, cov3D_precomp, sh,
    scales and rotations; zeros for what was not given.
    """
    gaussians = chosen(means3D, opacities, scales, rotations, cov3D_precomp, colors, sh)
    count, (height, width) = len(means3D), grad_out_color.shape[1:]
    floats, ints, longs = means3D.dtype, torch.int32, torch.int64
    geometry = (longs, (count + 1, 2)), (floats, (count, SPLAT_VALUES)), (ints, (count,))
    splat_slots, splats, tile_counts = _unpack(geomBuffer, geometry)
    (instances,) = _unpack(binningBuffer, [(ints, (num_rendered,))])
    tiles = -(-height // TILE) * -(-width // TILE)
    image = (longs, (tiles + 1,)), (floats, (1, height, width)), (ints, (height, width))
    ranges, transmittance, last = _unpack(imgBuffer, image)
    slots = instances.new_empty(int(splat_slots[-1, 0]), 0)

    place, lens = (viewmatrix, projmatrix, campos), (tan_fovx, tan_fovy, scale_modifier)
    scene = Scene(*gaussians, *camera_arguments(*place, lens, height, width, degree, antialiasing, False))
    background = shaped(background, 3)
    no_layers = splats.new_empty(0)  # the backward makes its own
    kept = splats, tile_counts, instances, ranges, splat_slots, slots, last, no_layers, background, transmittance
    planes = grad_out_color, None, given(grad_out_invdepth)
    screen, *found = gradients_of(scene, kept, planes, [True, *(values is not None for values in gaussians)])
    by_name = dict(zip(Gaussians._fields, found, strict=True))
    shapes = {"scales": (3,), "rotations": (4,), "cov3d": (6,), "colors": (3,), "sh_rest": (0, 3)}
    for name, shape in shapes.items():
        if by_name[name] is None:
            by_name[name] = means3D.new_zeros(count, *shape)
    if gaussians.sh_dc is not None:
        by_name["sh_rest"] = torch.cat([by_name["sh_dc"], by_name["sh_rest"]], 1)
    names = "colors", "opacities", "means", "cov3d", "sh_rest", "scales", "rotations"
    return screen, *(by_name[name] for name in names)


@torch.no_grad()
def adamUpdate(
    param: Tensor,
    grad: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    visibility: Tensor,
    lr: float,
    b1: float,
    b2: float,
    eps: float,
    N: int,
    M: int,
) -> None:
    """Takes one step of Adam in place, for the rows that are visible (`optim.sparse_adam_`).

    visibility: (rows,) bool.
    N, M: number of rows, and of values in a row. They are ignored, because the tensors' shapes tell them.
    """
    sparse_adam_(param, grad, exp_avg, exp_avg_sq, visibility, lr, b1, b2, eps)


def _pack(*tensors: Tensor) -> Tensor:
    """Copies tensors of several types into one of bytes, (B,) uint8, as the reference hands a state around."""
    return torch.cat([values.contiguous().reshape(-1).view(torch.uint8) for values in tensors])


def _unpack(buffer: Tensor, parts: Iterable[tuple[torch.dtype, tuple[int, ...]]]) -> list[Tensor]:
    """Copies the tensors of `_pack` out again, given their dtypes and shapes.

    Raises ValueError if the buffer has another size.
    """
    parts = list(parts)
    sizes = [math.prod(shape) * dtype.itemsize for dtype, shape in parts]
    if buffer.dtype != torch.uint8 or buffer.shape != (sum(sizes),):
        found = f"{tuple(buffer.shape)} {buffer.dtype}"
        raise ValueError(f"the buffer must be the one of this rendering, ({sum(sizes)},) uint8, got {found}")
    pieces = zip(buffer.split(sizes), parts, strict=True)
    # In memory of their own, since kernels may want more alignment than a place within the buffer has.
    return [piece.clone().view(dtype).reshape(shape) for piece, (dtype, shape) in pieces]
