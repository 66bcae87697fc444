"""Means exactly on borders, against the oracle: pixel centres, edges of tiles, edges and corners of images.

Focal lengths and depths are powers of two, so that a mean's place on the image has no rounding in either precision.
Every place of a row is combined with every place of a column.
"""

import functools
import math

import pytest
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, reference
from rasterizer_tools import BOTH_AND_GPU, Evaluated, errors_above, evaluate, move_camera, ops, scene_arguments
from torch import Tensor

from tests.workloads.splat_scenes import settings

FOCAL = 32.0
SIZES = {"whole tiles": (64, 32), "cut tiles": (50, 21)}
# Size in pixels, and opacity. That of one pixel, on its centre, is below 1/255 everywhere else.
KINDS = {"one pixel": (1e-3, 0.012), "tiny": (0.3, 0.8), "large": (24.0, 0.3)}
BOUNDS = {torch.float64: 2e-14, torch.float32: 1.5e-5}  # about twice the largest measured


def _places(pixels: int) -> list[float]:
    """Places along a side, px: pixel centres are whole numbers, and edges of tiles lie half a pixel before 16 n."""
    edges = {0, 16, pixels // 16 * 16, pixels}
    return sorted({edge + offset for edge in edges for offset in (-1.0, -0.5, 0.0, 0.5)})


def _view(size: tuple[int, int], dtype: torch.dtype, projection: str) -> GaussianRasterizationSettings:
    """A pinhole of the focal length; its principal point is the centre of a pixel."""
    principal = tuple(1 / pixels if pixels % 2 == 0 else 0.0 for pixels in size)
    made = settings(*size, dtype, principal=principal, projection=projection)
    tan_x, tan_y = (pixels / 2 / FOCAL for pixels in size)
    projmatrix = made.projmatrix.clone()
    projmatrix[0, 0], projmatrix[1, 1] = 1 / tan_x, 1 / tan_y
    return made._replace(tanfovx=tan_x, tanfovy=tan_y, projmatrix=projmatrix)


def _scene(kind: str, size: tuple[int, int], turn: int) -> tuple[dict[str, Tensor], Tensor]:
    """Raw parameters of a Gaussian on each place of a row, and their places (N, 2) px; turn: chooses the columns."""
    across, down = (_places(pixels) for pixels in size)
    at = torch.tensor([(x, down[(k + turn) % len(down)]) for k, x in enumerate(across)], dtype=torch.float64)
    n, draw = len(at), torch.Generator().manual_seed(turn)
    depth = 2.0 ** (torch.randperm(n, generator=draw) - 1)
    centre = torch.tensor([pixels // 2 for pixels in size])
    pixels, opacity = KINDS[kind]
    parameters = {
        "means": torch.cat([(at - centre) / FOCAL * depth[:, None], depth[:, None]], 1),
        "opacities": torch.full((n, 1), math.log(opacity / (1 - opacity))),
        "scales": torch.log(pixels * depth[:, None] / FOCAL) + 0.3 * torch.randn(n, 3, generator=draw),
        "rotations": torch.randn(n, 4, generator=draw),
        "sh_dc": 0.8 + 0.3 * torch.randn(n, 1, 3, generator=draw),
        "sh_rest": 0.1 * torch.randn(n, 15, 3, generator=draw),
    }
    return {name: t.float() for name, t in parameters.items()}, at


@functools.cache
def _oracle(kind: str, size: tuple[int, int], turn: int, projection: str):
    parameters, at = _scene(kind, size, turn)
    return parameters, at, _evaluated(parameters, _view(size, torch.float64, projection), function=reference.render)


def _evaluated(parameters: dict[str, Tensor], view: GaussianRasterizationSettings, *place, **options) -> Evaluated:
    """With the gradients of means times depth: else those of far Gaussians would not count."""
    found = evaluate(parameters, view, *place, **options)
    found.named["d means"] *= parameters["means"][:, 2:]
    return found


@BOTH_AND_GPU
@pytest.mark.parametrize("projection", ["ewa", "ray"])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("kind", KINDS)
def test_means_on_borders_agree_with_the_oracle(device, dtype, kind, size, projection):
    size = SIZES[size]
    view = _view(size, dtype, projection)
    for turn in range(len(_places(size[1]))):
        parameters, at, wanted = _oracle(kind, size, turn, projection)
        rows = {name: t.to(device, dtype) for name, t in parameters.items()}
        splats, _, _, counts, _ = (t.cpu() for t in ops.project(*scene_arguments(rows, move_camera(view, device))))
        listed = counts > 0
        assert torch.equal(splats[listed, :2].double(), at[listed])
        assert wanted.keep.double().mean() > 0.99
        got = _evaluated(parameters, view, wanted.keep, device)
        assert errors_above(got, wanted, BOUNDS[dtype]) == {}
        if dtype == torch.float64:
            assert torch.equal(got.radii, wanted.radii)
