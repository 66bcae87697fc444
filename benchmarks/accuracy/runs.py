"""Planes and gradients of a problem by the kernels, the oracle, and the textbook's formulas."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from diff_gaussian_rasterization import rasterize, reference
from torch import Tensor

from tests.workloads import textbook
from tests.workloads.splat_scenes import move_camera
from tests.workloads.stability_cases import Problem
from utils.system_utils import compute_device

PLANES = ("color", "inverse_depth", "transmittance")


class Backend(NamedTuple):
    """A renderer with the dtype and device that it runs in."""

    name: str
    render: Callable
    dtype: torch.dtype
    device: str


CPU_FLOAT = Backend("CPU float32", rasterize, torch.float32, "cpu")
CPU_DOUBLE = Backend("CPU float64", rasterize, torch.float64, "cpu")
CUDA_FLOAT = Backend("CUDA float32", rasterize, torch.float32, "cuda")
TEXTBOOK = Backend("textbook float32", textbook.render, torch.float32, "cpu")
ORACLE = Backend("oracle", reference.render, torch.float64, "cpu")


def kernels() -> list[Backend]:
    """List the kernels of this build that can run on this machine."""
    return [CPU_FLOAT, *([CUDA_FLOAT] if compute_device().type == "cuda" else []), CPU_DOUBLE]


def run(problem: Problem, backend: Backend, rows: Tensor | None = None, keep: Tensor | None = None, cut: float = 0.0):
    """Return planes and gradients by name, in float64 on the CPU, and the pixels that count, (H, W) bool.

    The gradients are those of the sum of the planes over these pixels, with fixed random weights. rows: (N,) bool, the
    Gaussians to render (default: all). keep: the pixels that count, by default those that the oracle finds farther than
    `cut` from a cut-off.
    """
    device = backend.device
    chosen = {k: t if rows is None else t[rows] for k, t in problem.parameters.items()}
    leaves = {k: t.to(device, backend.dtype, copy=True).requires_grad_() for k, t in chosen.items()}
    camera = move_camera(problem.camera, device)
    means2d = torch.zeros_like(leaves["means"], requires_grad=True)
    named = {k: t for k, t in leaves.items() if k not in ("means", "opacities")}
    if backend.render is rasterize:
        named |= {"want_inverse_depth": True, "want_transmittance": True}
    if backend.render is reference.render:
        named |= {"cut": cut}
    out = backend.render(leaves["means"], means2d, leaves["opacities"], camera, raw=problem.raw, **named)
    keep = ~out.near_cut if keep is None else keep
    planes = [getattr(out, name) for name in PLANES]
    generator = torch.Generator().manual_seed(7)
    weights = [torch.randn(plane.shape, generator=generator, dtype=torch.float64) * keep for plane in planes]
    sum((plane * weight.to(plane)).sum() for plane, weight in zip(planes, weights, strict=True)).backward()
    gradients = {name: leaf.grad for name, leaf in leaves.items()} | {"screen mean": means2d.grad[:, :2]}
    return _to_doubles(dict(zip(PLANES, planes, strict=True))), _to_doubles(gradients), keep


def _to_doubles(named: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: t.detach().double().cpu() for name, t in named.items()}
