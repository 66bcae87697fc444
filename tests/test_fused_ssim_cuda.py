"""fused_ssim on the GPU against float64, the CPU backend and itself."""

import pytest
import torch
from fused_ssim import fused_l1_ssim, fused_photometric_loss, fused_ssim
from fused_ssim.reference import l1_ssim
from test_fused_ssim import (
    CASES,
    EPS,
    PAIRS,
    image_pair,
    loss_and_gradient,
    loss_in_parts,
    out_of_range,
    with_gradient,
)
from test_loss_by_bands import check_bands
from test_loss_by_bands import image_pair as render_and_photo
from torch import Tensor, library

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no NVIDIA GPU"),
]
eps = EPS[torch.float32]
# Tiles of a plane are 8 or 16 rows by 116 columns (csrc/cuda/ssim_tile.h), by the number of pixels.
CUTS = [(3, 16, 116), (3, 17, 117), (1, 45, 233), (3, 800, 800), (3, 1060, 1600), (600, 39, 3)]


def paddings(shape: tuple[int, ...]) -> list[str]:
    return ["same", "valid"] if min(shape[-2:]) >= 11 else ["same"]


def on_gpu(img1: Tensor, img2: Tensor, padding: str) -> tuple[Tensor, Tensor, Tensor]:
    results = with_gradient(fused_l1_ssim, img1.cuda(), img2.cuda(), padding)
    assert all(result.is_cuda and result.dtype == torch.float32 for result in results)
    return tuple(result.cpu() for result in results)


@pytest.mark.parametrize(("name", "shape"), CASES, ids=str)
def test_agrees_with_reference(name: str, shape: tuple[int, ...]) -> None:
    """Tolerances are those of the CPU backend; test_fused_ssim.py explains them."""
    img1, img2 = image_pair(name, shape, torch.float32)
    for padding in paddings(shape):
        l1, ssim, gradient = on_gpu(img1, img2, padding)
        wanted_l1, wanted_ssim, wanted_gradient = with_gradient(l1_ssim, img1.double(), img2.double(), padding)
        assert abs(l1 - wanted_l1) <= 2 * eps * wanted_l1
        assert abs(ssim - wanted_ssim) <= 8 * eps
        scale = wanted_gradient.abs().max() * max(1, img1.abs().max())
        assert (gradient - wanted_gradient).abs().max() <= 40 * eps * scale + 100 * EPS[torch.float64]


@pytest.mark.parametrize("as_bytes", [False, True], ids=["float", "bytes"])
@pytest.mark.parametrize("shape", CUTS, ids=str)
def test_agrees_with_the_cpu(shape: tuple[int, ...], as_bytes: bool) -> None:
    img1, img2 = image_pair("noise", shape, torch.float32)
    if as_bytes:
        img2 = (255 * img2).to(torch.uint8)
    for padding in paddings(shape):
        results, wanted = on_gpu(img1, img2, padding), with_gradient(fused_l1_ssim, img1, img2, padding)
        # Differences of pixels are the same floats; their double sums, in another order, are rounded once.
        assert abs(results[0] - wanted[0]) <= 2 * eps * wanted[0]
        assert abs(results[1] - wanted[1]) <= 8 * eps
        assert (results[2] - wanted[2]).abs().max() <= 40 * eps * wanted[2].abs().max()


@pytest.mark.parametrize("name", PAIRS)
def test_both_gradients_add_up_as_on_the_cpu(name: str) -> None:
    img1, img2 = image_pair(name, (3, 70, 131), torch.float32)
    gradients = []
    for device in ("cuda", "cpu"):
        x = img1.to(device).requires_grad_()
        l1, ssim = fused_l1_ssim(x, img2.to(device))
        gradients.append(torch.autograd.grad(0.8 * l1 - 0.2 * ssim, x)[0].cpu())
    largest = gradients[1].abs().max() * max(1, img1.abs().max())
    assert (gradients[0] - gradients[1]).abs().max() <= 40 * eps * largest


def test_l1_gradient_is_torchs() -> None:
    img1, img2 = (image.cuda() for image in image_pair("noise", dtype=torch.float32))
    img1[:, 3:9] = img2[:, 3:9]
    gradients = []
    for l1 in (lambda x: fused_l1_ssim(x, img2)[0], lambda x: (x - img2).abs().mean()):
        x = img1.clone().requires_grad_()
        gradients.append(torch.autograd.grad(l1(x), x)[0])
    torch.testing.assert_close(gradients[0], gradients[1], rtol=2 * eps, atol=0)
    assert not gradients[0][:, 3:9].any()


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_equal_images(value: float) -> None:
    image = torch.full((3, 20, 130), value)
    l1, ssim, gradient = on_gpu(image, image, "same")
    assert l1 == 0 and ssim == 1 and not gradient.any()


def test_the_value_is_the_same_with_and_without_a_gradient() -> None:
    img1, img2 = (image.cuda() for image in image_pair("noise", (3, 201, 300), torch.float32))
    for padding in ("same", "valid"):
        plain = fused_l1_ssim(img1, img2, padding)
        trained = fused_l1_ssim(img1.clone().requires_grad_(), img2, padding)
        assert plain[0] == trained[0] and plain[1] == trained[1]
    assert torch.ops.fused_ssim.l1_ssim(img1, img2, False, False)[2].numel() == 0


def opcheck_forward(operator, *arguments: object) -> None:
    """opcheck, without its comparison of what is kept for the backward: that has memory that nobody writes or reads."""
    checks = ["test_schema", "test_autograd_registration", "test_faketensor", "test_aot_dispatch_dynamic"]
    library.opcheck(operator, arguments, test_utils=checks[:3] if arguments[-1] else checks)


def test_compiled_calls_give_the_same_values_and_gradients() -> None:
    image, target = (one.cuda() for one in image_pair("noise", (2, 12, 13), torch.float32))
    for function in (
        lambda one: sum(fused_l1_ssim(one, target)),
        lambda one: fused_photometric_loss(one, target, 0.2)[0],
    ):
        results = []
        for call in (function, torch.compile(function, backend="aot_eager")):
            leaf = image.clone().requires_grad_()
            value = call(leaf)
            results.append((value.detach(), *torch.autograd.grad(value, leaf)))
        assert all(torch.equal(*pair) for pair in zip(*results, strict=True))


@pytest.mark.parametrize("train", [False, True])
def test_opcheck(train: bool) -> None:
    img1, img2 = (image.cuda() for image in image_pair("noise", (2, 12, 13), torch.float32))
    opcheck_forward(torch.ops.fused_ssim.l1_ssim, img1.clone().requires_grad_(train), img2, True, train)
    one = torch.ones((), device="cuda")
    kept = torch.ops.fused_ssim.l1_ssim(img1, img2, False, True)[2]
    library.opcheck(torch.ops.fused_ssim.l1_ssim_vjp, (img1, img2, kept, one, one))


@pytest.mark.parametrize("as_bytes", [False, True], ids=["float", "bytes"])
def test_photometric_loss_agrees_with_the_cpu_and_its_parts(as_bytes: bool) -> None:
    image, target = out_of_range(torch.float32, as_bytes)
    on_cpu = loss_and_gradient(fused_photometric_loss, image, target, 0.2)
    image, target = image.cuda(), target.cuda()
    fused = loss_and_gradient(fused_photometric_loss, image, target, 0.2)
    in_parts = loss_and_gradient(loss_in_parts, image, target, 0.2)
    assert torch.equal(fused[1], in_parts[1]) and torch.equal(fused[2], in_parts[2])
    assert abs(fused[0] - in_parts[0]) <= 2 * eps  # the GPU fuses a product with the sum
    assert abs(fused[0].cpu() - on_cpu[0]) <= 10 * eps
    assert (fused[2].cpu() - on_cpu[2]).abs().max() <= 40 * eps * on_cpu[2].abs().max()
    torch.cuda.set_sync_debug_mode("error")
    try:
        loss_and_gradient(fused_photometric_loss, image, target, 0.2)
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.parametrize("train", [False, True])
def test_opcheck_photometric(train: bool) -> None:
    image, target = (image.cuda() for image in image_pair("noise", (2, 12, 13), torch.float32))
    opcheck_forward(torch.ops.fused_ssim.photometric, image.requires_grad_(train), target, 0.2, train)
    kept = torch.ops.fused_ssim.photometric(image.detach(), target, 0.2, True)[2]
    arguments = (image.detach(), target, kept, 0.2, torch.ones((), device="cuda"))
    library.opcheck(torch.ops.fused_ssim.photometric_vjp, arguments)


def all_bits(img1: Tensor, img2: Tensor) -> list[Tensor]:
    img1 = img1.detach().requires_grad_()
    l1, ssim = fused_l1_ssim(img1, img2)
    return [l1.detach(), ssim.detach(), torch.autograd.grad(l1 + ssim, img1)[0].reshape(-1)]


def test_every_run_gives_the_same_bits() -> None:
    img1, img2 = (image.cuda() for image in image_pair("noise", (3, 540, 960), torch.float32))
    wanted = all_bits(img1, img2)
    for _ in range(20):
        torch.empty(1 << 20, device="cuda").fill_(float("nan"))  # the next call's temporary memory
        assert all(torch.equal(one, other) for one, other in zip(all_bits(img1, img2), wanted, strict=True))


def test_strides_and_alignment_change_no_bit() -> None:
    img1, img2 = (image.cuda() for image in image_pair("noise", (4, 20, 21), torch.float32))
    wanted = all_bits(img1, img2)
    views = {
        "more dimensions": lambda x: x.reshape(2, 1, 2, 20, 21),
        "channels last": lambda x: x[None].to(memory_format=torch.channels_last),
        "every other column": lambda x: x.repeat_interleave(2, dim=2)[:, :, ::2],
        "off by one": lambda x: torch.cat([x.new_zeros(1), x.reshape(-1)])[1:].view(x.shape),
    }
    for name, view in views.items():
        for got, bits in zip(all_bits(view(img1), view(img2)), wanted, strict=True):
            assert torch.equal(got, bits), name


def test_what_is_kept_may_be_a_view() -> None:
    img1, img2 = (image.cuda() for image in image_pair("noise", (4, 20, 21), torch.float32))
    one = torch.ones((), device="cuda")
    kept = torch.ops.fused_ssim.l1_ssim(img1, img2, False, True)[2]
    view = torch.cat([kept.new_zeros(1), kept.reshape(-1)])[1:].view(kept.shape)
    wanted, got = (torch.ops.fused_ssim.l1_ssim_vjp(img1, img2, k, one, one) for k in (kept, view))
    assert torch.equal(got, wanted)


def test_runs_on_the_current_stream() -> None:
    img1, img2 = (image.cuda() for image in image_pair("noise", (3, 300, 400), torch.float32))
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


def test_does_not_wait_for_the_gpu() -> None:
    img1, img2 = (image.cuda() for image in image_pair("noise", (3, 30, 40), torch.float32))
    all_bits(img1, img2)
    torch.cuda.set_sync_debug_mode("error")
    try:
        all_bits(img1, img2)
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_pixel_that_is_not_finite_shows(value: float) -> None:
    img1, img2 = image_pair("noise", dtype=torch.float32)
    img1[1, 39, 46] = value
    l1, ssim = fused_l1_ssim(img1.cuda(), img2.cuda())
    assert not l1.isfinite() and ssim.isnan()


def test_messages() -> None:
    image = torch.zeros(3, 20, 20, device="cuda")
    with pytest.raises(TypeError, match="img1 on cuda:0 must be float32, got torch.float64"):
        fused_ssim(image.double(), image.double())
    with pytest.raises(ValueError, match="same device, got img1 on cuda:0 and img2 on cpu"):
        fused_ssim(image, image.cpu())
    # The operator itself checks inputs that bypass the Python function.
    with pytest.raises(RuntimeError, match="img1 must be float32 on a GPU"):
        torch.ops.fused_ssim.l1_ssim(image.double(), image.double(), False, False)
    with pytest.raises(RuntimeError, match=r"kept must be \(3, 1, 20, 408\)"):
        torch.ops.fused_ssim.l1_ssim_vjp(image, image, image, torch.ones(()), torch.ones(()))
    kept = torch.ops.fused_ssim.l1_ssim(image, image, False, True)[2]
    with pytest.raises(RuntimeError, match="gradients must be float32"):
        torch.ops.fused_ssim.l1_ssim_vjp(image, image, kept, torch.ones(()), torch.ones(()))


@pytest.mark.parametrize(
    ("height", "width", "borders"),
    [(70, 33, [0, 1, 1, 3, 5]), (97, 600, [0, 0, 4, 7]), (960, 538, [0, 30, 60]), (1060, 1600, [0, 20, 67])],
)
@pytest.mark.parametrize("as_bytes", [True, False], ids=["bytes", "floats"])
def test_bands_have_the_loss_and_the_gradient_of_the_whole_image(height, width, borders, as_bytes):
    """The last image is so large that blocks of the forward have 16 rows; a band of the third by itself is small."""
    images = render_and_photo(height, width, torch.float32, as_bytes)
    check_bands(height, borders, tuple(image.cuda() for image in images))
