"""fused_ssim against float64 convolutions, scikit-image, finite differences, the CPU and itself."""

import pytest
import torch
from fused_ssim import allowed_padding, fused_l1_ssim, fused_photometric_loss, fused_ssim
from fused_ssim.reference import l1_ssim, ssim_map
from rasterizer_tools import BOTH_AND_GPU, CPU_AND_GPU, GPU_MARKS, moved_by_a_word
from skimage.metrics import structural_similarity
from torch import Tensor

EPS = {torch.float32: 2**-24, torch.float64: 2**-53}
LARGEST_SLOPE = 2 / 0.03**2  # of SSIM over a covariance; multiplies an error of the inputs or of the oracle
on_a_gpu = pytest.mark.parametrize("device", [pytest.param("cuda", marks=GPU_MARKS)])


def image_pair(name: str, shape: tuple[int, ...] = (3, 40, 47), dtype: torch.dtype = torch.float64) -> list[Tensor]:
    """Named pairs of images, exact in float32, each difficult for some way of computing SSIM."""
    random = torch.Generator().manual_seed(7)
    noise1, noise2 = torch.randn(shape, generator=random), torch.randn(shape, generator=random)
    if name == "noise":
        pair = (0.5 + 0.2 * noise1).clamp(0, 1), (0.5 + 0.2 * noise1 + 0.1 * noise2).clamp(0, 1)
    elif name == "unrelated":
        pair = torch.rand(shape, generator=random), torch.rand(shape, generator=random)
    elif name == "nearly equal":
        pair = (0.5 + 0.2 * noise1, 0.5 + 0.2 * noise1 + 1e-4 * noise2)
    elif name == "bright sky":  # E[x²] - mu² is all rounding here
        pair = 0.95 + 0.001 * noise1, 0.951 + 0.001 * noise2
    elif name == "flat":
        pair = torch.full(shape, 0.98), torch.full(shape, 1.0)
    elif name == "black and flat":
        pair = torch.zeros(shape), torch.full(shape, 0.3)
    elif name == "salt on white":
        pair = 1 - (noise1 > 2).float(), 1 - (noise2 > 2).float()
    elif name == "overexposed":  # a render need not be clamped
        pair = 3 + 2 * noise1, (0.5 + 0.2 * noise2).clamp(0, 1)
    return [image.to(dtype) for image in pair]


PAIRS = ["noise", "unrelated", "nearly equal", "bright sky", "flat", "black and flat", "salt on white", "overexposed"]
# Tiles of the CPU are 32 rows by 2 KB.
SHAPES = [(1, 1, 1), (2, 3, 7, 5), (3, 2, 70), (65, 3), (11, 11), (1, 12, 1030), (33, 257), (31, 255)]
CASES = [(name, (3, 40, 47)) for name in PAIRS] + [("unrelated", shape) for shape in SHAPES]


def with_gradient(function, img1: Tensor, img2: Tensor, padding: str) -> tuple[Tensor, Tensor, Tensor]:
    """L1, SSIM and the gradient of the sum of SSIM, which does not depend on the number of pixels as a mean does."""
    img1 = img1.clone().requires_grad_()
    l1, ssim = function(img1, img2, padding)
    rim = 10 if padding == "valid" else 0
    count = img1.numel() // (img1.shape[-1] * img1.shape[-2]) * (img1.shape[-1] - rim) * (img1.shape[-2] - rim)
    (gradient,) = torch.autograd.grad(ssim * count, img1)
    return l1.detach(), ssim.detach(), gradient


def paddings(shape: tuple[int, ...]) -> list[str]:
    return ["same", "valid"] if min(shape[-2:]) >= 11 else ["same"]


def on_device(device: str, img1: Tensor, img2: Tensor, padding: str) -> list[Tensor]:
    """The results of the device, on the CPU."""
    results = with_gradient(fused_l1_ssim, img1.to(device), img2.to(device), padding)
    assert all(result.device.type == device and result.dtype == img1.dtype for result in results)
    return [result.cpu() for result in results]


@BOTH_AND_GPU
@pytest.mark.parametrize(("name", "shape"), CASES, ids=str)
def test_agrees_with_reference(name: str, shape: tuple[int, ...], device: str, dtype: torch.dtype) -> None:
    img1, img2 = image_pair(name, shape, dtype)
    for padding in paddings(shape):
        l1, ssim, gradient = on_device(device, img1, img2, padding)
        assert l1.shape == ssim.shape == ()
        wanted_l1, wanted_ssim, wanted_gradient = with_gradient(l1_ssim, img1.double(), img2.double(), padding)
        # Each pixel's difference is rounded once, and the mean once.
        assert abs(l1 - wanted_l1) <= 2 * EPS[dtype] * wanted_l1
        # A few roundings of numbers near 1, measured: 4.3 eps; also of the sums in double if all pixels are equal.
        assert abs(ssim - wanted_ssim) <= 8 * EPS[dtype] + (50 * EPS[dtype] if dtype == torch.float64 else 0)
        # Measured: 19 eps of the largest gradient for images in [0, 1]; the difference is rounded at the size of the
        # larger image. The oracle adds up terms of about 10 in size that may cancel.
        scale = wanted_gradient.abs().max() * max(1, img1.abs().max())
        error = (gradient - wanted_gradient).abs().max()
        assert error <= 40 * EPS[dtype] * scale + 100 * EPS[torch.float64]


# Tiles of a plane are 8 or 16 rows by 116 columns (csrc/cuda/ssim_tile.h), by the number of pixels.
CUTS = [(3, 16, 116), (3, 17, 117), (1, 45, 233), (3, 800, 800), (3, 1060, 1600), (600, 39, 3)]


@on_a_gpu
@pytest.mark.parametrize("as_bytes", [False, True], ids=["float", "bytes"])
@pytest.mark.parametrize("shape", CUTS, ids=str)
def test_agrees_with_the_cpu(shape: tuple[int, ...], as_bytes: bool, device: str) -> None:
    img1, img2 = image_pair("noise", shape, torch.float32)
    if as_bytes:
        img2 = (255 * img2).to(torch.uint8)
    for padding in paddings(shape):
        results, wanted = on_device(device, img1, img2, padding), on_device("cpu", img1, img2, padding)
        # Differences of pixels are the same floats; their double sums, in another order, are rounded once.
        assert abs(results[0] - wanted[0]) <= 2 * EPS[torch.float32] * wanted[0]
        assert abs(results[1] - wanted[1]) <= 8 * EPS[torch.float32]
        assert (results[2] - wanted[2]).abs().max() <= 40 * EPS[torch.float32] * wanted[2].abs().max()


@pytest.mark.parametrize("name", ["noise", "salt on white"])
def test_agrees_with_scikit_image(name: str) -> None:
    img1, img2 = image_pair(name)
    wanted, full = structural_similarity(
        img1.numpy(),
        img2.numpy(),
        channel_axis=0,
        data_range=1,
        gaussian_weights=True,  # cut at 3.5 sigma: 11 taps
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    # scikit-image averages without a rim of 5 pixels, where its border would differ from ours. Its variances are
    # E[x²] - mu², divided by C2 at worst.
    tolerance = 20 * EPS[torch.float64] * LARGEST_SLOPE
    assert abs(float(fused_ssim(img1, img2, padding="valid")) - wanted) < tolerance
    difference = (ssim_map(img1, img2) - torch.from_numpy(full))[:, 5:-5, 5:-5].abs().max()
    assert difference < tolerance  # scikit-image also checks the oracle


@CPU_AND_GPU
def test_l1_gradient_is_torchs(device: str) -> None:
    img1, img2 = (image.to(device) for image in image_pair("noise", dtype=torch.float32))
    img1[:, 3:9] = img2[:, 3:9]  # no gradient where both are equal
    gradients = []
    for l1 in (lambda x: fused_l1_ssim(x, img2)[0], lambda x: (x - img2).abs().mean()):
        x = img1.clone().requires_grad_()
        gradients.append(torch.autograd.grad(l1(x), x)[0])
    # We round 1/n once from double; torch computes it in float.
    torch.testing.assert_close(gradients[0], gradients[1], rtol=2 * EPS[torch.float32], atol=0)
    assert not gradients[0][:, 3:9].any()


def loss_in_parts(image: Tensor, target: Tensor, weight: float, clamp: bool = True) -> tuple[Tensor, Tensor]:
    """Compute fused_photometric_loss by torch around fused_l1_ssim."""
    l1, ssim = fused_l1_ssim(image.clamp(0, 1) if clamp else image, target)
    return (1 - weight) * l1 + weight * (1 - ssim), l1


def loss_and_gradient(function, image: Tensor, target: Tensor, weight: float, *clamp: bool) -> list[Tensor]:
    """Loss, L1 and the gradient of three times the loss."""
    image = image.detach().requires_grad_()
    loss, l1 = function(image, target, weight, *clamp)
    return [loss.detach(), l1.detach(), torch.autograd.grad(3 * loss, image)[0]]


def out_of_range(dtype: torch.dtype, as_bytes: bool = False) -> list[Tensor]:
    """A render with values below 0, above 1, and of exactly 0 and 1, and its photo."""
    image = image_pair("overexposed", dtype=dtype)[0] - 2.5
    image[:, :4], image[:, 4:8] = 0, 1
    target = image_pair("noise", dtype=dtype)[1]
    return [image, (255 * target).to(torch.uint8) if as_bytes else target]


@BOTH_AND_GPU
@pytest.mark.parametrize("as_bytes", [False, True], ids=["float", "bytes"])
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_photometric_loss_is_its_parts(weight: float, as_bytes: bool, device: str, dtype: torch.dtype) -> None:
    on_cpu = out_of_range(dtype, as_bytes)
    image, target = (tensor.to(device) for tensor in on_cpu)
    outside = (image < 0) | (image > 1)
    assert outside.float().mean() > 0.3
    for clamp in (True, False):
        fused = loss_and_gradient(fused_photometric_loss, image, target, weight, clamp)
        loss, *rest = loss_and_gradient(loss_in_parts, image, target, weight, clamp)
        assert all(torch.equal(*pair) for pair in zip(fused[1:], rest, strict=True))
        assert all(got.dtype == dtype for got in fused) and fused[2][outside].any() != clamp
        if device == "cpu":
            assert torch.equal(fused[0], loss)
            continue
        assert abs(fused[0] - loss) <= 2 * EPS[dtype] * max(1, loss)  # the GPU fuses a product with the sum
        if not clamp:
            continue
        wanted = loss_and_gradient(fused_photometric_loss, *on_cpu, weight, clamp)
        assert abs(fused[0].cpu() - wanted[0]) <= 10 * EPS[dtype]
        assert (fused[2].cpu() - wanted[2]).abs().max() <= 40 * EPS[dtype] * wanted[2].abs().max()


def test_photometric_loss_keeps_nothing_it_does_not_need() -> None:
    image, target = out_of_range(torch.float32)
    loss, l1 = fused_photometric_loss(image, target, 0.2)
    assert not loss.requires_grad and torch.ops.fused_ssim.photometric(image, target, 0.2, False)[2].numel() == 0
    trained, trained_l1 = fused_photometric_loss(image.requires_grad_(), target, 0.2)
    assert trained.requires_grad and not trained_l1.requires_grad
    assert trained == loss and trained_l1 == l1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_bytes_are_their_value_over_255(dtype: torch.dtype) -> None:
    img1 = image_pair("noise", (3, 16, 17), dtype)[0].requires_grad_()
    bytes2 = (torch.arange(img1.numel()) % 256).to(torch.uint8).reshape(img1.shape)  # every value
    results = []
    for img2 in (bytes2, bytes2.to(dtype) / 255):
        l1, ssim = fused_l1_ssim(img1, img2)
        results.append([l1, ssim, torch.autograd.grad(l1 + ssim, img1)[0]])
    for one, other in zip(*results, strict=True):
        assert torch.equal(one, other)


@BOTH_AND_GPU
@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_equal_images(value: float, device: str, dtype: torch.dtype) -> None:
    noise = image_pair("bright sky", dtype=dtype)[0]
    for image in (torch.full((3, 20, 130), value, dtype=dtype), noise):
        l1, ssim, gradient = on_device(device, image, image, "same")
        assert l1 == 0 and ssim == 1 and not gradient.any()


def all_bits(img1: Tensor, img2: Tensor) -> list[Tensor]:
    img1 = img1.detach().requires_grad_()
    l1, ssim = fused_l1_ssim(img1, img2)
    return [l1.detach(), ssim.detach(), torch.autograd.grad(l1 + ssim, img1)[0].reshape(-1)]


@CPU_AND_GPU
def test_leading_dimensions_and_strides(device: str) -> None:
    img1, img2 = (image.to(device) for image in image_pair("noise", (4, 20, 21), torch.float32))
    wanted = all_bits(img1, img2)
    views = {
        "more dimensions": lambda x: x.reshape(2, 1, 2, 20, 21),
        "channels last": lambda x: x[None].to(memory_format=torch.channels_last),
        "transposed": lambda x: x.transpose(1, 2).contiguous().transpose(1, 2),
        "every other column": lambda x: x.repeat_interleave(2, dim=2)[:, :, ::2],
        "off by one": moved_by_a_word,
    }
    for name, view in views.items():
        for got, bits in zip(all_bits(view(img1), view(img2)), wanted, strict=True):
            assert torch.equal(got, bits), name
    one_plane = fused_ssim(img1[0], img2[0])
    assert one_plane == fused_ssim(img1[:1], img2[:1])
    one = torch.ones((), device=device)
    kept = torch.ops.fused_ssim.l1_ssim(img1, img2, False, True)[2]
    got = [torch.ops.fused_ssim.l1_ssim_vjp(img1, img2, k, one, one) for k in (kept, moved_by_a_word(kept))]
    assert torch.equal(*got)


@on_a_gpu
def test_runs_on_the_current_stream(device: str) -> None:
    img1, img2 = (image.to(device) for image in image_pair("noise", (3, 300, 400), torch.float32))
    wanted = all_bits(img1, img2)
    late1, late2 = torch.zeros_like(img1), torch.zeros_like(img2)
    torch.cuda.synchronize()
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        torch.cuda._sleep(50_000_000)  # tens of milliseconds in which another stream would read the zeros
        late1.copy_(img1)
        late2.copy_(img2)
        got = all_bits(late1, late2)
    stream.synchronize()
    assert all(torch.equal(one, other) for one, other in zip(got, wanted, strict=True))


@on_a_gpu
def test_does_not_wait_for_the_gpu(device: str) -> None:
    image, target = (tensor.to(device) for tensor in image_pair("noise", (3, 30, 40), torch.float32))
    for mode in ("default", "error"):
        torch.cuda.set_sync_debug_mode(mode)
        try:
            all_bits(image, target)
            loss_and_gradient(fused_photometric_loss, image, target, 0.2)
        finally:
            torch.cuda.set_sync_debug_mode("default")


@CPU_AND_GPU
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_pixel_that_is_not_finite_shows(value: float, device: str) -> None:
    img1, img2 = image_pair("noise", dtype=torch.float32)
    img1[1, 39, 46] = value
    img1, img2 = img1.to(device), img2.to(device)
    l1, ssim = fused_l1_ssim(img1, img2)
    assert not l1.isfinite() and ssim.isnan()
    assert not fused_photometric_loss(img1, img2, 0.2, False)[0].isfinite()
    assert fused_photometric_loss(img1, img2, 0.2)[0].isnan() == (value != value)  # the clamp makes 1 of infinity


@CPU_AND_GPU
def test_only_img1_has_a_gradient_and_only_when_wanted(device: str) -> None:
    img1, img2 = (image.to(device) for image in image_pair("noise", (3, 201, 300), torch.float32))
    plain = [fused_l1_ssim(img1, img2, padding) for padding in allowed_padding]
    assert plain[0][1] != plain[1][1]
    assert torch.ops.fused_ssim.l1_ssim(img1, img2, False, False)[2].numel() == 0
    img1.requires_grad_(), img2.requires_grad_()
    assert [fused_l1_ssim(img1, img2, padding) for padding in allowed_padding] == plain
    assert not fused_ssim(img1, img2, train=False).requires_grad
    with torch.no_grad():
        assert not fused_ssim(img1, img2).requires_grad
    assert not fused_ssim(img1.detach(), img2).requires_grad
    fused_ssim(img1, img2).backward()
    assert img1.grad is not None and img2.grad is None


@on_a_gpu
def test_messages_of_a_gpu(device: str) -> None:
    image = torch.zeros(3, 20, 20, device=device)
    with pytest.raises(TypeError, match="img1 on cuda:0 must be float32, got torch.float64"):
        fused_ssim(image.double(), image.double())
    with pytest.raises(ValueError, match="same device, got img1 on cuda:0 and img2 on cpu"):
        fused_ssim(image, image.cpu())
    # The operator itself checks inputs that bypass the Python function.
    kept = torch.ops.fused_ssim.l1_ssim(image, image, False, True)[2]
    one = torch.ones((), device=device)
    refused = {r"kept must be \(3, 1, 20, 408\)": (image, one), "must be on cuda:0 like img1": (kept, one.cpu())}
    for message, (maps, gradient) in refused.items():
        with pytest.raises((RuntimeError, TypeError), match=message):
            torch.ops.fused_ssim.l1_ssim_vjp(image, image, maps, gradient, gradient)


_LOSSES = {
    "both means": lambda one, two: sum(fused_l1_ssim(one, two)),
    "photometric": lambda one, two: fused_photometric_loss(one, two, 0.2)[0],
}


@CPU_AND_GPU
@pytest.mark.parametrize("loss", _LOSSES.values(), ids=_LOSSES)
def test_torch_compile_gives_the_same_values_and_gradients(loss, device):
    one, two = (image.to(device) for image in image_pair("noise", (3, 20, 20), torch.float32))
    one.requires_grad_()
    torch._dynamo.reset()
    values = [call(one, two) for call in (loss, torch.compile(loss, backend="aot_eager"))]
    assert torch.equal(*values)
    assert torch.equal(*(torch.autograd.grad(value, one)[0] for value in values))
