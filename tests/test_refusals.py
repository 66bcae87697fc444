"""Refusals of the extensions' functions, by name. Those of the rasterizer: test_rasterizer_api.py."""

import math

import pytest
import torch
from diff_gaussian_rasterization.lens import Lens
from fused_ssim import composite, fused_ssim
from lens_scenes import PANORAMA
from rasterizer_tools import few, render
from simple_knn._C import distCUDA2
from torch import Tensor

from tests.workloads.splat_scenes import settings

IMAGE, PICTURE = torch.zeros(3, 20, 20), torch.zeros(4, 2, 2, dtype=torch.uint8)
LENS = Lens("equidistant", (9.0, 9.0), (8.5, 3.0))
SSIM = [
    (IMAGE, torch.zeros(3, 20, 21), "same", r"ValueError: .*\(3, 20, 20\) and img2 \(3, 20, 21\)"),
    (IMAGE.byte(), IMAGE, "same", "TypeError: img1 must be float32 or float64, got torch.uint8"),
    (IMAGE.half(), IMAGE.half(), "same", "TypeError: .*got torch.float16"),
    (IMAGE, IMAGE.double(), "same", "TypeError: img2 must be torch.float32 like img1, or uint8"),
    (IMAGE, IMAGE, "full", 'ValueError: .*"same" or "valid", got \'full\''),
    (IMAGE[:, :10], IMAGE[:, :10], "valid", r"ValueError: .*at least 11 x 11 pixels, got img1 \(3, 10, 20\)"),
    (IMAGE[:, :0], IMAGE[:, :0], "same", "ValueError: .*at least one pixel"),
    (IMAGE[0, 0], IMAGE[0, 0], "same", r"ValueError: .*must be \(..., H, W\)"),
    (IMAGE, IMAGE.to("meta"), "same", "ValueError: .*same device, got img1 on cpu and img2 on meta"),
]
COMPOSITE = [
    (PICTURE[:3], IMAGE[:, 0, 0], r"RuntimeError: picture must be \(4, H, W\) uint8, got .3, 2, 2. torch.uint8"),
    (PICTURE.float(), IMAGE[:, 0, 0], r"RuntimeError: picture must be \(4, H, W\) uint8, got .4, 2, 2. torch.float32"),
    (PICTURE, torch.zeros(4), "RuntimeError: .*background must be 3 float32, got .4,. torch.float32"),
]
POINTS = [
    (torch.zeros(5, 2), r"ValueError: points must be \(N, 3\), got \(5, 2\)"),
    (torch.zeros(3), r"ValueError: points must be \(N, 3\), got \(3,\)"),
    (torch.zeros(5, 3, dtype=torch.int64), "TypeError: .*float32 or float64, got torch.int64"),
    (torch.zeros(5, 3).half(), "TypeError: .*float32 or float64, got torch.float16"),
]
BY_OPERATOR = [  # which checks what bypasses the function
    (torch.zeros(5, 2), r"RuntimeError: .*points must be \(N, 3\)"),
    (torch.zeros(5, 3).half(), "RuntimeError: .*points must be float32 or float64"),
]
PROJECTIONS = [
    ({"projection": "affine"}, "ValueError: projection must be 'ewa' or 'ray', got 'affine'"),
    (
        {"projection": "ray", "lens": Lens("equirectangular", (9.0, 9.0), (8.5, 3.0), radial=(0.1, 0, 0, 0))},
        "ValueError: .*panoramas without distortion",
    ),
    (
        {"projection": "ray", "lens": LENS._replace(focal=(6.0, 9.0))},
        "ValueError: .*needs tiles of 16 pixels to span under 150 degrees",
    ),
    *(
        ({"lens": PANORAMA._replace(focal=(wrong, 60.0))}, "ValueError: .*finite numbers and focal lengths above 0")
        for wrong in (math.nan, 0.0)
    ),
    (
        {"lens": PANORAMA._replace(chart="fisheye")},
        "ValueError: .*chart 'fisheye' is none of perspective, equidistant, equirectangular",
    ),
]


def draw(options: dict) -> Tensor:
    parameters, size = few()
    return render(parameters, settings(**size, **options)).color


CALLS = {
    fused_ssim: SSIM,
    composite: COMPOSITE,
    distCUDA2: POINTS,
    torch.ops.simple_knn.mean_distance2: BY_OPERATOR,
    draw: PROJECTIONS,
}


@pytest.mark.parametrize(
    ("function", "arguments", "words"), [(f, row[:-1], row[-1]) for f, rows in CALLS.items() for row in rows]
)
def test_what_does_not_fit_is_named(function, arguments, words):
    kind, _, message = words.partition(": ")
    with pytest.raises(Exception, match=message) as error:
        function(*arguments)
    assert error.type.__name__ == kind
