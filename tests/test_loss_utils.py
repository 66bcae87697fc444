"""Losses and scores against SciPy and scikit-image."""

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate1d
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from utils.image_utils import as_float, mse, psnr
from utils.loss_utils import l1_loss, l2_loss, photometric_loss, ssim


def _pair(height: int, width: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    first = torch.rand(3, height, width, generator=generator)
    return first, (first + 0.2 * torch.randn(3, height, width, generator=generator)).clamp(0, 1)


def _ssim_map(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The SSIM map of (3, H, W) in double, with zeros outside, by SciPy's correlation."""
    window = np.exp(-0.5 * ((np.arange(11) - 5) / 1.5) ** 2)
    window /= window.sum()

    def blur(x: np.ndarray) -> np.ndarray:
        return correlate1d(correlate1d(x, window, axis=1, mode="constant"), window, axis=2, mode="constant")

    ma, mb = blur(a), blur(b)
    va, vb, cab = blur(a * a) - ma * ma, blur(b * b) - mb * mb, blur(a * b) - ma * mb
    return (2 * ma * mb + 1e-4) * (2 * cab + 9e-4) / ((ma * ma + mb * mb + 1e-4) * (va + vb + 9e-4))


@pytest.mark.parametrize("size", [(37, 53), (7, 9), (1, 1), (11, 24)])
def test_plain_ssim_equals_a_double_precision_correlation(size):
    a, b = _pair(*size)
    expected = _ssim_map(a.double().numpy(), b.double().numpy()).mean()
    # Variances are differences of blurred squares near 1, so float32 errors are some 1e-6 (2^-24 * 11 / 9e-4 a pixel).
    assert abs(ssim(a, b).item() - expected) < 1e-5
    assert abs(ssim(a.double(), b.double()).item() - expected) < 1e-12


def test_plain_ssim_agrees_with_scikit_image_inside():
    a, b = _pair(40, 50)
    _, full = structural_similarity(
        a.double().numpy(), b.double().numpy(), channel_axis=0, data_range=1.0, gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, full=True,
    )  # fmt: skip
    ours = _ssim_map(a.double().numpy(), b.double().numpy())
    np.testing.assert_allclose(ours[:, 5:-5, 5:-5], full[:, 5:-5, 5:-5], atol=1e-12)


def test_ssim_takes_batches():
    a, b = _pair(20, 20)
    c, d = _pair(20, 20, seed=1)
    both = ssim(torch.stack((a, c)), torch.stack((b, d)), size_average=False)
    assert torch.allclose(both, torch.stack((ssim(a, b), ssim(c, d))), atol=1e-6)


@pytest.mark.parametrize("as_bytes", [False, True])
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_fused_loss_follows_the_plain_formula(weight, as_bytes):
    image, target = _pair(33, 45)
    if as_bytes:
        target = (target * 255).round().to(torch.uint8)
    image.requires_grad_(True)
    loss, l1 = photometric_loss(image, target, weight)
    (gradient,) = torch.autograd.grad(loss, image)
    exact = image.detach().double().requires_grad_(True)
    wanted = target.double() / 255 if as_bytes else target.double()
    plain = (1 - weight) * l1_loss(exact, wanted) + weight * (1 - ssim(exact, wanted))
    (exact_gradient,) = torch.autograd.grad(plain, exact)
    assert abs(loss.item() - plain.item()) < 1e-5  # as for the plain SSIM in float32
    assert abs(l1.item() - l1_loss(exact, wanted).item()) < 1e-6
    assert (gradient - exact_gradient).abs().max() < 1e-4 * exact_gradient.abs().max()


@pytest.mark.parametrize("masked", [False, True])
def test_the_loss_clamps_the_image(masked):
    image, target = _pair(20, 30)
    image = 2 * image - 0.5
    mask = torch.rand(1, 20, 30, generator=torch.Generator().manual_seed(3)) < 0.8 if masked else None
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
