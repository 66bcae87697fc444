"""Shared by the rasterizer's tests: both renderers under one call, the error as the design defines it, and scenes."""

import math
from collections.abc import Callable
from typing import NamedTuple

import pytest
import torch
from diff_gaussian_rasterization import (
    GaussianRasterizationSettings,
    Gaussians,
    Rasterized,
    has_cuda_kernels,
    optim,
    rasterize,
)
from diff_gaussian_rasterization import ops as functions
from diff_gaussian_rasterization.backend import OPERATORS as ops
from torch import Tensor

from tests.workloads.splat_scenes import move_camera, settings

GPU_MARKS = (
    pytest.mark.gpu,
    pytest.mark.skipif(
        not (torch.cuda.is_available() and has_cuda_kernels()), reason="needs a GPU and a build with CUDA"
    ),
)
PLANES = ("color", "inverse_depth", "transmittance")
_PLACES = {"float64": ("cpu", torch.float64), "float32": ("cpu", torch.float32), "cuda": ("cuda", torch.float32)}


def _param(name: str, *values: object) -> object:
    return pytest.param(*values, id=name, marks=GPU_MARKS if name == "cuda" else ())


# For tests that run on a GPU as well (benchmarks/device.sh finds the files by "_AND_GPU"). DTYPES_AND_GPU is for tests
# that make all their tensors without naming a device: the fixture `dtype` makes it torch's default.
CPU_AND_GPU = pytest.mark.parametrize("device", [_param(name, name) for name in ("cpu", "cuda")])
BOTH_AND_GPU = pytest.mark.parametrize(("device", "dtype"), [_param(k, *place) for k, place in _PLACES.items()])
DTYPES_AND_GPU = pytest.mark.parametrize("dtype", [_param(k, place) for k, place in _PLACES.items()], indirect=True)


def moved_by_a_word(t: Tensor) -> Tensor:
    """The same values, which begin at no multiple of 8 bytes."""
    return torch.cat((t.new_zeros(1), t.reshape(-1)))[1:].view(t.shape)


class Error(NamedTuple):
    """Largest and median difference of a tensor, over the largest value of its reference."""

    largest: float
    median: float


def error(got: Tensor, reference: Tensor) -> Error:
    """Compares two tensors: infinite where `got` has a NaN, absolute where the reference is all zero."""
    difference = (got.double() - reference.double()).abs().nan_to_num(nan=math.inf)
    scale = reference.abs().max().item() or 1.0
    return Error(difference.max().item() / scale, difference.median().item() / scale)


def adam(
    value: Tensor,
    gradient: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    rate: float,
    betas: tuple[float, float],
    eps: float,
    step: float,
    columns: int = -1,
) -> None:
    """Takes Adam's step number `step`, counted from 1, of one tensor."""
    counter = torch.tensor(step - 1.0)
    optim.adam_([value], [gradient], [exp_avg], [exp_avg_sq], [counter], [rate], *betas, eps, [columns])


def render(
    parameters: dict[str, Tensor],
    camera: GaussianRasterizationSettings,
    means2d: Tensor | None = None,
    *,
    function=rasterize,
    raw: bool = True,
    **wanted: bool,
) -> Rasterized:
    """Calls `rasterize`, or the oracle's `render` given as function, on parameters by name."""
    rest = dict(parameters)
    means, opacities = rest.pop("means"), rest.pop("opacities")
    means2d = torch.zeros_like(means) if means2d is None else means2d
    if function is rasterize:
        wanted = {"want_inverse_depth": True, "want_transmittance": True} | wanted
    return function(means, means2d, opacities, camera, **rest, raw=raw, **wanted)


def leaves(parameters: dict[str, Tensor], dtype: torch.dtype | None = None) -> dict[str, Tensor]:
    """Copies parameters; the copies require gradients."""
    return {name: t.detach().clone().to(dtype or t.dtype).requires_grad_() for name, t in parameters.items()}


def gradients(
    parameters: dict[str, Tensor],
    camera: GaussianRasterizationSettings,
    device: str = "cpu",
    loss: Callable[[Rasterized], Tensor] | None = None,
    **options,
) -> dict[str, Tensor]:
    """Renders on `device`, and returns on the CPU, by name: the planes, and every gradient of a loss of theirs.

    loss: `loss_of` if None.
    """
    inputs = leaves({name: t.to(device) for name, t in parameters.items()})
    means2d = torch.zeros_like(inputs["means"]).requires_grad_()
    out = render(inputs, move_camera(camera, device), means2d, **options)
    (loss or loss_of)(out).backward()
    named = {f"d {name}": t.grad for name, t in [*inputs.items(), ("means2d", means2d)]}
    return {name: t.detach().cpu() for name, t in (out._asdict() | named).items()}


def loss_of(out: NamedTuple, keep: Tensor | None = None) -> Tensor:
    """Sums all three planes with fixed random weights. keep (H, W) bool: only these pixels count."""
    generator = torch.Generator().manual_seed(5)
    loss = 0.0
    for plane in (out.color, out.inverse_depth, out.transmittance):
        weights = torch.randn(plane.shape, generator=generator, dtype=torch.float64)
        weights = weights if keep is None else weights * keep
        loss = loss + (weights.to(plane.device) * plane.double()).sum()
    return loss


class Evaluated(NamedTuple):
    """Planes and gradients by name, the pixels (H, W) that count, and the radii."""

    named: dict[str, Tensor]
    keep: Tensor
    radii: Tensor


def evaluate(
    parameters: dict[str, Tensor],
    camera: GaussianRasterizationSettings,
    keep: Tensor | None = None,
    device: str = "cpu",
    **options,
) -> Evaluated:
    """Renders in the camera's dtype. keep: pixels that count; None, of the oracle: those that are near no cut-off."""
    inputs = {name: t.to(camera.bg.dtype) for name, t in parameters.items()}

    def loss(out):
        return loss_of(out, ~out.near_cut if keep is None else keep)

    found = gradients(inputs, camera, device, loss, **options)
    counted = ~found["near_cut"] if keep is None else keep
    named = {name: found[name] * counted for name in PLANES} | {n: t for n, t in found.items() if n.startswith("d ")}
    return Evaluated(named, counted, found["radii"])


def errors_above(got: Evaluated, wanted: Evaluated, bound: float) -> dict[str, float]:
    """The largest errors, by name, that are not within a bound."""
    errors = {name: error(got.named[name], t).largest for name, t in wanted.named.items()}
    return {name: largest for name, largest in errors.items() if not largest <= bound}


def activated(parameters: dict[str, Tensor]) -> dict[str, Tensor]:
    """Applies the activations to raw parameters, as the reference's API wants them."""
    out = dict(parameters)
    out["opacities"] = torch.sigmoid(out["opacities"])
    out["scales"] = torch.exp(out["scales"])
    out["rotations"] = out["rotations"] / out["rotations"].norm(dim=1, keepdim=True)
    return out


def keywords(splats: dict[str, Tensor]) -> dict[str, Tensor]:
    """Arguments of GaussianRasterizer, by their names, of `activated` parameters."""
    return {
        "means3D": splats["means"],
        "means2D": torch.zeros_like(splats["means"]),
        "opacities": splats["opacities"],
        "shs": torch.cat([splats["sh_dc"], splats["sh_rest"]], 1),
        "scales": splats["scales"],
        "rotations": splats["rotations"],
    }


def rotation_matrix(q: Tensor) -> Tensor:
    """Rotation (3, 3) of a quaternion w x y z of any length, as the product of its left and right multiplication."""
    w, x, y, z = (q.double() / q.double().norm()).tolist()
    left = torch.tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]], dtype=torch.float64)
    right = torch.tensor([[w, x, y, z], [-x, w, -z, y], [-y, z, w, -x], [-z, -y, x, w]], dtype=torch.float64)
    return (left @ right)[1:, 1:]


def rigid(q: tuple[float, ...], translation: tuple[float, ...]) -> Tensor:
    """Rigid motion (4, 4) from world to view, not transposed."""
    view = torch.eye(4, dtype=torch.float64)
    view[:3, :3] = rotation_matrix(torch.tensor(q))
    view[:3, 3] = torch.tensor(translation, dtype=torch.float64)
    return view


def few(n: int = 3, width: int = 18, height: int = 7, dtype: torch.dtype = torch.float64) -> tuple[dict, dict]:
    """Makes raw parameters of few splats, and the arguments of `settings`. 1/255 < alpha < 0.99 on every pixel."""
    g = torch.Generator().manual_seed(11)
    depth = 2.0 + torch.arange(n) / 2
    focal = width / (2 * math.tan(math.radians(30)))
    across = torch.rand(n, 2, generator=g) - 0.5
    offset = across * torch.tensor([width, height]) * 0.6 * depth[:, None] / focal
    parameters = {
        "means": torch.cat([offset, depth[:, None]], 1),
        "opacities": 0.5 * torch.randn(n, 1, generator=g),
        "scales": torch.log(9 * depth[:, None] / focal) + 0.3 * torch.randn(n, 3, generator=g),
        "rotations": torch.randn(n, 4, generator=g),
        "sh_dc": 0.8 + 0.3 * torch.randn(n, 1, 3, generator=g),
        "sh_rest": 0.1 * torch.randn(n, 15, 3, generator=g),
    }
    return {k: v.to(dtype) for k, v in parameters.items()}, {"width": width, "height": height, "dtype": dtype}


def one_splat(
    x: float = 0.0,
    y: float = 0.0,
    z: float = 1.0,
    *,
    opacity: float = 0.5,
    scale: float = 0.05,
    color: tuple[float, float, float] = (1.0, 0.5, 0.25),
    dtype: torch.dtype = torch.float64,
) -> dict[str, Tensor]:
    """Makes one isotropic Gaussian, activated, with a colour of its own."""
    return {
        "means": torch.tensor([[x, y, z]], dtype=dtype),
        "opacities": torch.tensor([[opacity]], dtype=dtype),
        "scales": torch.full((1, 3), scale, dtype=dtype),
        "rotations": torch.tensor([[1.0, 0, 0, 0]], dtype=dtype),
        "colors": torch.tensor([color], dtype=dtype),
    }


def together(*splats: dict[str, Tensor]) -> dict[str, Tensor]:
    """Joins several scenes, as `one_splat` makes them, into one."""
    return {name: torch.cat([s[name] for s in splats]) for name in splats[0]}


def pick(parameters: dict[str, Tensor], rows) -> dict[str, Tensor]:
    """Keeps these rows of a scene."""
    return {name: t[rows] for name, t in parameters.items()}


def scene_arguments(parameters: dict[str, Tensor], camera: GaussianRasterizationSettings, raw: bool = True) -> tuple:
    """Arguments that the operators have in common, in their order."""
    return functions.scene_arguments(Gaussians(**parameters), camera, raw)


def everywhere(depths: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Lists every splat in every tile, by depth, ties by index: instances and ranges."""
    order = torch.argsort(depths, stable=True).to(torch.int32)
    tiles = -(-width // 16) * -(-height // 16)
    return order.repeat(tiles), len(order) * torch.arange(tiles + 1, device=depths.device)


def assert_culling_is_exact(
    splats: Tensor, depths: Tensor, rects: Tensor, counts: Tensor, width: int, height: int, also: Tensor | None = None
) -> tuple[int, int]:
    """Asserts that blending `bin`'s lists gives the bits of blending all splats everywhere.

    also (K, 11): rows and depths of splats that `project` left out, which the second list has as well. Returns the
    numbers of instances of both lists.
    """
    background = torch.tensor([0.3, 0.6, 0.1], dtype=splats.dtype, device=splats.device)
    # A GPU sums a list by chunks of 256 splats, so that its bits depend on the chunks. Here no list has two.
    parts = max(1, -(-(len(splats) + (0 if also is None else len(also))) // 256)) if splats.is_cuda else 1
    total = [0, 0]
    for part in range(parts):
        rows, depth = splats[part::parts], depths[part::parts]
        lists = ops.bin(rows, depth, rects[part::parts], counts[part::parts], height, width, False)[:2]
        got = ops.blend(rows, *lists, background, height, width, True, False)
        seen = counts[part::parts] > 0
        rows, depth = rows[seen], depth[seen]
        if also is not None:
            left_out = also[part::parts]
            rows, depth = torch.cat([rows, left_out[:, :10]]), torch.cat([depth, left_out[:, 10]])
        all_lists = everywhere(depth, width, height)
        wanted = ops.blend(rows, *all_lists, background, height, width, True, False)
        for a, b in zip(got[:3], wanted[:3], strict=True):
            assert torch.equal(a, b)
        total = [total[0] + len(lists[0]), total[1] + len(all_lists[0])]
    return total[0], total[1]


def borderline_splats(n: int, width: int, height: int, dtype: torch.dtype, device: str = "cpu") -> tuple[Tensor, ...]:
    """Projects splats whose alpha at one pixel on the rim of one tile is 1/255, within some units in the last place.

    Returns `project`'s splats, depths, rects and counts, and the rows that it left out, as `also` takes them.
    """
    g = torch.Generator().manual_seed(6)
    focal = width / (2 * math.tan(math.radians(30)))
    z = 2 + torch.rand(n, 1, generator=g)
    span = torch.tensor([width, height]) * 1.2 / focal
    parameters = {
        "means": torch.cat([(torch.rand(n, 2, generator=g) - 0.5) * span * z, z], 1),
        "opacities": torch.ones(n, 1),
        "scales": torch.exp(torch.randn(n, 3, generator=g)) * 3 * z / focal,
        "rotations": torch.nn.functional.normalize(torch.randn(n, 4, generator=g)),
        "colors": torch.rand(n, 3, generator=g),
    }
    parameters["scales"][: n // 2] = parameters["scales"][: n // 2, :1]
    parameters = {name: t.to(device, dtype) for name, t in parameters.items()}
    camera = move_camera(settings(width, height, dtype), device)
    splats, depths, _, counts, _ = ops.project(*scene_arguments(parameters, camera, raw=False))
    # The corner of a tile, not far from the mean: where a tile's least distance is at a pixel centre.
    u, v = (2 * torch.randn(2, n, generator=g)).clamp(-2.5, 2.5).to(device)
    dy = v / splats[:, 4]
    pixel = splats[:, :2] + torch.stack([(u - splats[:, 3] * dy) / splats[:, 2], dy], 1)
    pixel = (pixel / 16).round() * 16
    pixel = torch.where(pixel > splats[:, :2], pixel, pixel - 1)
    pixel = torch.minimum(pixel.clamp(min=0), torch.tensor([width - 1, height - 1], device=device))
    dx, dy = (pixel.double() - splats[:, :2].double()).unbind(1)
    u, v = splats[:, 2].double() * dx + splats[:, 3].double() * dy, splats[:, 4].double() * dy
    step = torch.randint(-8, 9, (n,), generator=g).to(device) * torch.finfo(dtype).eps
    tuned = torch.exp2(u * u + v * v) / 255 * (1 + step)
    usable = (counts > 0) & (tuned < 0.9)
    assert usable.sum() > n / 3
    parameters["opacities"] = tuned[:, None].to(dtype)
    parameters = pick(parameters, usable)
    rows = splats[usable], depths[usable]
    splats, depths, rects, counts, _ = ops.project(*scene_arguments(parameters, camera, raw=False))
    dropped = rows[0][counts == 0].clone()
    dropped[:, 5] = torch.log2(parameters["opacities"][counts == 0, 0])
    return splats, depths, rects, counts, torch.cat([dropped, rows[1][counts == 0, None]], 1)
