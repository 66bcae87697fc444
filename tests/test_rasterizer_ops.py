"""The operators: their names and sizes, and what is too large for them."""

import pytest
import torch
from diff_gaussian_rasterization import fakes
from diff_gaussian_rasterization.lens import Lens
from rasterizer_tools import few, ops, render, scene_arguments

from groundwork.ranks.rows import BLOCK
from tests.workloads.splat_scenes import settings


def test_the_fake_kernels_have_the_blocks_of_the_real_ones():
    """Check where one block more begins; test_operator_arguments.py checks all other sizes."""
    raw, size = few(dtype=torch.float32)
    camera = settings(**size)
    splats, depths, rects, counts, _ = ops.project(*scene_arguments(raw, camera))
    no_rows = [splats, counts, splats.new_zeros(0, fakes.MOMENT_VALUES), 0 * counts]
    for lens, numbers in zip((None, Lens("perspective", (9.0, 9.0), (8.0, 3.0))), fakes.CAMERA_NUMBERS, strict=True):
        assert ops.camera_vjp(*scene_arguments(raw, camera._replace(lens=lens)), no_rows).shape == (1, numbers)
    assert ops.sum_blocks(torch.tensor([[1.0, 2.0], [3.0, 5.0]]).double()).tolist() == [4.0, 7.0]
    for size, tiles in ((fakes.TILE, 1), (fakes.TILE + 1, 4)):
        assert len(ops.bin(splats, depths, rects, 0 * counts, size, size, False)[1]) == tiles + 1
    assert fakes.SLEEP_BLOCK == BLOCK
    rects, limits = torch.zeros(fakes.RECORD_BLOCK + 1, 4, dtype=torch.int32), torch.zeros(2, 3, dtype=torch.int32)
    for splats, blocks in ((fakes.RECORD_BLOCK, 1), (fakes.RECORD_BLOCK + 1, 2)):
        assert ops.list_records(rects[:splats], rects[:splats, 0], limits)[0].shape == (4, blocks)


@pytest.mark.parametrize(
    ("counts", "named"),
    [
        ((2**31 - 1,) * 3, r"\d \(2147483647\), \d \(2147483647\), \d \(2147483647\)"),
        ((7, 2**31 - 1, 2**30), r"1 \(2147483647\), 2 \(1073741824\), 0 \(7\)"),
    ],
)
def test_more_instances_than_an_index_holds_are_an_error(counts, named):
    """The call is refused before allocating: 6.4 billion instances would be 50 GB. It names the largest splats."""
    raw, size = few(dtype=torch.float32)
    splats, depths, rects, _, _ = ops.project(*scene_arguments(raw, settings(**size)))
    faked = torch.tensor(counts, dtype=torch.int32)
    with pytest.raises(
        RuntimeError,
        match=f"3 Gaussians cover {sum(counts)} tile instances, more than 2.31 - 1; most are those of Gaussian {named}",
    ):
        ops.bin(splats, depths, rects, faked, 7, 18, True)


def test_an_image_of_more_tiles_than_an_index_holds_is_an_error():
    """The call is refused at once, since counting the tiles of a giant splat would take hours."""
    raw, size = few(dtype=torch.float32)
    camera = settings(**size)._replace(image_width=2**23, image_height=2**23)
    with pytest.raises(RuntimeError, match=r"image size 8388608x8388608 has more than 2\^31 - 1 tiles"):
        render(raw, camera)
