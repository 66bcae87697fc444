"""fused_ssim.composite: photos with alpha over a background."""

import itertools

import torch
from fused_ssim import composite
from rasterizer_tools import CPU_AND_GPU
from torch import Tensor

BACKGROUND = torch.tensor([0.2, 0.0, 1.0])


def every_pair() -> Tensor:
    """All 65,536 pairs of colour and alpha, (4, 256, 256) uint8; each channel has another background."""
    values = torch.arange(256, dtype=torch.uint8)
    color, alpha = torch.meshgrid(values, values, indexing="ij")
    return torch.stack((color, color, color, alpha))


def in_torch(picture: Tensor, background: Tensor) -> Tensor:
    scaled = picture / 255
    return scaled[:3] * scaled[3:] + background[:, None, None] * (1 - scaled[3:])


@CPU_AND_GPU
def test_every_value_is_torchs_to_the_bit(device: str) -> None:
    """Both devices give the bits of torch on the CPU, which rounds each operation, and are close to float64."""
    picture = every_pair()
    got = composite(picture.to(device), BACKGROUND.to(device)).cpu()
    assert got.dtype == torch.float32 and torch.equal(got, in_torch(picture, BACKGROUND))
    exact = in_torch(picture.double(), BACKGROUND.double())
    assert (got - exact).abs().max() <= 3 * 2**-24  # three roundings of numbers up to 1
    assert torch.equal(got[:, :, 0], BACKGROUND[:, None].expand(3, 256))
    assert torch.equal(got[:, :, 255], picture[:3, :, 255] / 255)


@CPU_AND_GPU
def test_sizes_and_strides(device: str) -> None:
    for height, width in itertools.product((0, 1, 7), (1, 300)):
        picture = torch.full((4, height, width), 128, dtype=torch.uint8)
        picture[3, :, ::2] = 255
        wanted = in_torch(picture, BACKGROUND)
        turned = picture.permute(1, 2, 0).contiguous().permute(2, 0, 1)  # strides as in Pillow's memory
        for same in (picture, turned):
            assert torch.equal(composite(same.to(device), BACKGROUND.to(device)).cpu(), wanted)
