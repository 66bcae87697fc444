"""`rasterize_channels`: images of any number of channels, beside triples of channels that `rasterize` draws."""

import itertools

import pytest
import torch
from diff_gaussian_rasterization import rasterize
from diff_gaussian_rasterization.channels import rasterize_channels
from rasterizer_tools import BOTH_AND_GPU, CPU_AND_GPU, activated, error, leaves
from torch import Tensor

from tests.workloads.splat_scenes import SplatScene, move_camera, needles, ordinary

COUNTS = (1, 2, 3, 4, 5, 8, 11, 32)


def inputs_of(scene: SplatScene, channels: int, device: str, dtype: torch.dtype) -> tuple[dict, Tensor, Tensor]:
    """Gaussians without colours, their features, some below 0, and a background."""
    generator = torch.Generator().manual_seed(channels)
    given = {k: v.to(device, dtype) for k, v in activated(scene.parameters).items() if not k.startswith("sh")}
    features = torch.randn(len(given["means"]), channels, generator=generator, dtype=torch.float64)
    background = torch.rand(channels, generator=generator, dtype=torch.float64)
    return given, features.to(device, dtype), background.to(device, dtype)


def by_triples(given: dict, features: Tensor, background: Tensor, camera, means2d: Tensor, **options) -> Tensor:
    """The same channels, three at a time, drawn by `rasterize`."""
    missing = -features.shape[1] % 3
    features, background = (torch.nn.functional.pad(t, (0, missing)) for t in (features, background))
    images = []
    for colors, bg in zip(features.split(3, 1), background.split(3), strict=True):
        out = rasterize(means2d=means2d, settings=camera._replace(bg=bg), colors=colors, **given, **options)
        images.append(out.color)
    return torch.cat(images)[: len(background) - missing]


def loss_of(image: Tensor) -> Tensor:
    generator = torch.Generator().manual_seed(5)
    return (torch.randn(image.shape, generator=generator, dtype=torch.float64).to(image) * image).sum()


@BOTH_AND_GPU
@pytest.mark.parametrize(
    ("make", "channels", "projection"),
    [*itertools.product((ordinary, needles), COUNTS, ("ewa",)), (ordinary, 4, "ray"), (needles, 11, "ray")],
)
def test_channels_equal_triples(make, channels, projection, device, dtype):
    scene = make(300)
    camera = move_camera(scene.settings(), device)._replace(projection=projection)
    given, features, background = inputs_of(scene, channels, device, dtype)
    found = []
    for draw in (by_triples, None):
        inputs = leaves(given | {"features": features})
        own = inputs.pop("features")
        means2d = torch.zeros_like(inputs["means"], requires_grad=True)
        if draw:
            image = draw(inputs, own, background, camera, means2d)
        else:
            out = rasterize_channels(means2d=means2d, settings=camera._replace(bg=background), features=own, **inputs)
            image = out.image
        loss_of(image).backward()
        found.append({"image": image, "features": own.grad, "means2d": means2d.grad}
                     | {name: t.grad for name, t in inputs.items()})  # fmt: skip
    bound = 1e-12 if dtype == torch.float64 else 2e-5
    for name, expected in found[0].items():
        assert error(found[1][name], expected).largest < bound, name


@CPU_AND_GPU
def test_what_is_not_needed_gets_no_gradient(device):
    """Features alone; and the background, of which the gradient is the sum of what is left."""
    scene = ordinary(100)
    camera = move_camera(scene.settings(), device)
    given, features, background = inputs_of(scene, 7, device, torch.float32)
    features.requires_grad_()
    background.requires_grad_()
    means2d = torch.zeros_like(given["means"])
    out = rasterize_channels(means2d=means2d, settings=camera._replace(bg=background), features=features, **given)
    out.image.sum().backward()
    assert all(t.grad is None for t in given.values())
    assert torch.allclose(background.grad, out.transmittance.sum().expand(7), rtol=1e-5)
    again = rasterize_channels(means2d=means2d, settings=camera._replace(bg=background), features=features, **given)
    assert torch.equal(out.image, again.image)


@CPU_AND_GPU
def test_absolute_gradients_are_those_of_four_channels(device):
    scene = ordinary(200)
    camera = move_camera(scene.settings(), device)
    given, features, background = inputs_of(scene, 3, device, torch.float32)
    found = []
    for draw in (rasterize, rasterize_channels):
        means2d = torch.zeros_like(given["means"], requires_grad=True)
        name = "colors" if draw is rasterize else "features"
        options = {name: features, "want_absolute_gradient": True}
        out = draw(means2d=means2d, settings=camera._replace(bg=background), **given, **options)
        loss_of(out[0]).backward()
        found.append(means2d.grad)
    assert found[0][:, 2].any() and error(found[1], found[0]).largest < 2e-5


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"features": torch.zeros(3, 4)}, "features must be"),
        ({"features": torch.zeros(50, 4, dtype=torch.float64)}, "features must be .* of torch.float64"),
        ({"features": torch.zeros(50, 4).numpy()}, "features must be a tensor, got numpy.ndarray"),
        ({"means2d": torch.zeros(50, 2)}, r"means2d must be \(50, 3\) of torch.float32, got \(50, 2\)"),
        ({"debug": True, "features": torch.full((50, 4), torch.nan)}, "features has 200 values that are not finite"),
        ({"background": torch.zeros(2)}, "the background must have 4 values"),
        ({"want_absolute_gradient": True, "features": torch.zeros(50, 33)}, "at most 32 channels, got 33"),
        ({"features": torch.zeros(50, 0), "background": torch.zeros(1)}, "features must have a channel"),
        ({"most_alpha": 1.0}, "most_alpha must be above 1/255 and below 1, got 1.0"),
    ],
)
def test_wrong_inputs_are_named(change, words):
    scene = ordinary(50)
    given, features, background = inputs_of(scene, 4, "cpu", torch.float32)
    change = {"features": features, "background": background, "means2d": torch.zeros(50, 3), "debug": False} | change
    camera = scene.settings()._replace(bg=change.pop("background"), debug=change.pop("debug"))
    with pytest.raises((ValueError, TypeError, FloatingPointError), match=words):
        rasterize_channels(settings=camera, **given, **change)
