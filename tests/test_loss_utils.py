"""Losses and scores against SciPy and scikit-image."""

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate1d
from skimage.metrics import peak_signal_noise_ratio

from utils.image_utils import as_float, mse, psnr
from utils.loss_utils import (
    C1,
    C2,
    FusedSSIMMap,
    _ssim,
    create_window,
    fast_ssim,
    gaussian,
    l2_loss,
    photometric_loss,
    ssim,
)


def _pair(height: int, width: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    first = torch.rand(3, height, width, generator=generator)
    return first, (first + 0.2 * torch.randn(3, height, width, generator=generator)).clamp(0, 1)


def _ssim_map(a: np.ndarray, b: np.ndarray, size: int = 11) -> np.ndarray:
    """The SSIM map of (3, H, W) in double, with zeros outside, by SciPy's correlation."""
    window = np.exp(-0.5 * ((np.arange(size) - size // 2) / 1.5) ** 2)
    window /= window.sum()

    def blur(x: np.ndarray) -> np.ndarray:
        return correlate1d(correlate1d(x, window, axis=1, mode="constant"), window, axis=2, mode="constant")

    ma, mb = blur(a), blur(b)
    va, vb, cab = blur(a * a) - ma * ma, blur(b * b) - mb * mb, blur(a * b) - ma * mb
    return (2 * ma * mb + 1e-4) * (2 * cab + 9e-4) / ((ma * ma + mb * mb + 1e-4) * (va + vb + 9e-4))


@pytest.mark.parametrize(
    ("size", "window"), [((37, 53), 11), ((7, 9), 11), ((1, 1), 11), ((21, 30), 3), ((21, 30), 15)]
)
def test_ssim_equals_a_double_precision_correlation(size, window):
    a, b = _pair(*size)
    expected = _ssim_map(a.double().numpy(), b.double().numpy(), window).mean()
    # Variances are differences of blurred squares near 1, so float32 errors are some 1e-6 (2^-24 * 11 / 9e-4 a pixel).
    assert abs(ssim(a, b, window).item() - expected) < 1e-5
    assert abs(ssim(a.double(), b.double(), window_size=window).item() - expected) < 1e-12


def _gradients(a: torch.Tensor, b: torch.Tensor, wanted: tuple[bool, bool], function=ssim) -> list[torch.Tensor]:
    leaves = [image.clone().requires_grad_(want) for image, want in zip((a, b), wanted, strict=True)]
    function(*leaves).sum().backward()
    return [leaf.grad for leaf in leaves]


@pytest.mark.parametrize("average", [True, False])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_of_either_image_or_both_are_the_same(dtype, average):
    pairs = [_pair(20, 33, seed) for seed in (0, 1)]
    a, b = (torch.stack(images).to(dtype) for images in zip(*pairs, strict=True))

    def function(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return ssim(x, y, size_average=average)

    both = _gradients(a, b, (True, True), function)
    exact = _gradients(a.double(), b.double(), (True, True), function)
    tolerance = 1e-4 if dtype == torch.float32 else 1e-11  # of the largest; the plain form loses digits in variances
    for place, wanted in enumerate([(True, False), (False, True)]):
        one = _gradients(a, b, wanted, function)
        assert one[1 - place] is None
        for got in (one[place], both[place]):
            assert (got - exact[place]).abs().max() < tolerance * exact[place].abs().max()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no NVIDIA GPU")
def test_ssim_on_a_gpu_is_the_cpus():
    a, b = _pair(40, 50)
    for wanted in [(True, False), (False, True), (True, True)]:
        there = _gradients(a.cuda(), b.cuda(), wanted)
        for got, exact in zip(there, _gradients(a.double(), b.double(), wanted), strict=True):
            assert (got is None) == (exact is None)
            assert got is None or (got.cpu() - exact).abs().max() < 1e-4 * exact.abs().max()
    assert abs(ssim(a.cuda(), b.cuda()).item() - ssim(a.double(), b.double()).item()) < 1e-5
    # The kernels have no float64 on a GPU.
    assert abs(ssim(a.double().cuda(), b.double().cuda()).item() - ssim(a.double(), b.double()).item()) < 1e-12


def test_the_plain_form_takes_what_the_kernels_do_not():
    a, b = _pair(16, 16)
    assert abs(ssim(a.bfloat16(), b.bfloat16()).item() - ssim(a, b).item()) < 0.1  # 8 bits of precision
    batch = torch.stack((a, b))
    torch.testing.assert_close(ssim(batch, a[None]), (ssim(a, a) + ssim(b, a)) / 2)
    mapped = torch.vmap(lambda x, y: ssim(x, y))(batch, batch.flip(0))
    torch.testing.assert_close(mapped, torch.stack((ssim(a, b), ssim(b, a))))
    leaf = a.double().requires_grad_()
    other = b.double().requires_grad_()
    (slope,) = torch.autograd.grad(ssim(leaf, other), leaf, create_graph=True)  # of two images that need gradients
    assert torch.autograd.grad(slope.sum(), leaf)[0].isfinite().all()


def test_windows_of_the_caller():
    window = create_window(11, 3)
    assert window.shape == (3, 1, 11, 11) and window.dtype == torch.float32 and window.is_contiguous()
    taps = gaussian(11, 1.5)
    assert taps.shape == (11,) and taps.dtype == torch.float32
    np.testing.assert_allclose(taps.numpy(), np.exp(-((np.arange(11) - 5) ** 2) / 4.5) / 3.7592, rtol=1e-4)
    torch.testing.assert_close(window, torch.outer(taps, taps).expand(3, 1, 11, 11))
    torch.testing.assert_close(window.sum((1, 2, 3)), torch.ones(3))
    a, b = _pair(20, 21)
    assert abs(_ssim(a[None], b[None], window, 11, 3) - ssim(a, b)) < 1e-5
    assert abs(_ssim(a, b, window, 11, 3) - ssim(a, b)) < 1e-5
    each = _ssim(torch.stack((a, b)), torch.stack((b, b)), window, 11, 3, False)
    torch.testing.assert_close(each, torch.stack((ssim(a, b), ssim(b, b))), rtol=0, atol=1e-5)
    ones = torch.ones(3, 1, 3, 3) / 9  # another window than a Gaussian
    assert abs(_ssim(a, b, ones, 3, 3) - ssim(a, b)) > 1e-3


def test_fast_ssim_differentiates_its_first_image():
    a, b = _pair(20, 21)
    assert fast_ssim(a[None], b[None]) == ssim(a, b)
    first, second = _gradients(a, b, (True, True), fast_ssim)
    assert torch.equal(first, _gradients(a, b, (True, False))[0]) and second is None


def test_the_map_of_older_code():
    a, b = (image[None] for image in _pair(20, 21))
    whole = FusedSSIMMap.apply(C1, C2, a, b)
    wanted = _ssim_map(a[0].double().numpy(), b[0].double().numpy())
    np.testing.assert_allclose(whole[0].numpy(), wanted, atol=1e-3)  # a pixel in float32; see the error of the mean
    assert torch.equal(FusedSSIMMap.apply(C1, C2, a, b, "valid"), whole[..., 5:-5, 5:-5])
    leaf, other = a.clone().requires_grad_(), b.clone().requires_grad_()
    FusedSSIMMap.apply(C1, C2, leaf, other, "same", True).mean().backward()
    exact = _gradients(a.double(), b.double(), (True, False))[0]
    assert (leaf.grad - exact).abs().max() < 1e-4 * exact.abs().max() and other.grad is None
    assert not FusedSSIMMap.apply(C1, C2, leaf, b, train=False).requires_grad
    with pytest.raises(ValueError, match='"same" or "valid", got \'full\''):
        FusedSSIMMap.apply(C1, C2, a, b, "full")


def test_the_masked_loss_clamps_the_image():
    image, target = _pair(20, 30)
    image = 2 * image - 0.5
    mask = torch.rand(1, 20, 30, generator=torch.Generator().manual_seed(3)) < 0.8
    results = []
    for prepare in (lambda x: x, lambda x: x.clamp(0, 1)):
        leaf = image.clone().requires_grad_()
        loss, _ = photometric_loss(prepare(leaf), target, 0.2, mask)
        results.append((loss.detach(), *torch.autograd.grad(loss, leaf)))
    assert all(torch.equal(*pair) for pair in zip(*results, strict=True))
    outside = (image < 0) | (image > 1)
    assert outside.float().mean() > 0.3 and not results[0][1][outside].any() and results[0][1].any()


def test_scores_agree_with_scikit_image():
    a, b = _pair(30, 31)
    per_channel = [peak_signal_noise_ratio(a[c].numpy(), b[c].numpy(), data_range=1.0) for c in range(3)]
    assert psnr(a, b).shape == (3, 1)
    np.testing.assert_allclose(psnr(a, b).reshape(-1).numpy(), per_channel, rtol=1e-5)
    whole = peak_signal_noise_ratio(a.numpy(), b.numpy(), data_range=1.0)
    np.testing.assert_allclose(psnr(a[None], b[None]).item(), whole, rtol=1e-5)
    assert torch.allclose(mse(a[None], b[None]).squeeze(), l2_loss(a, b))


def test_bytes_become_fractions():
    assert torch.equal(as_float(torch.tensor([0, 51, 255], dtype=torch.uint8)), torch.tensor([0.0, 0.2, 1.0]))
    image = torch.rand(3, 2, 2)
    assert as_float(image) is image
