"""All errors of an image in one unit: what would have to be more exact, and what need not be.

    python -m benchmarks.accuracy.error_chart bonsai=OUT/bonsai --figure docs/errors.png  # needs matplotlib

The unit is the root of the mean square, in steps of 8 bits: 1 is the least difference that a PNG can hold, and squares
of independent errors add up. The dB beside it are the PSNR of an image with that error. An error is a difference from
the exact image: all in float64, with the cut-offs and the order of the rasterizer, of the model as its PLY holds it.
All but the last two are measured on the same random pixels of some views of each model.

- float32 arithmetic: the kernels in float32, with a camera in float32.
- inputs: one tensor of the PLY, or all, rounded to TF32 (10 bits), bfloat16 (7 bits) or half. Scales are logarithms
  there and opacities logits. All else is float64.
- cut-offs: no Gaussian is left out for an alpha below 1/255, or none for a transmittance below 1e-4.
- EWA against rays: the other projection.
- order: each pixel blends by the depths on its own ray (benchmarks.accuracy.popping).
- JPEG: the noise of the photos. A photo without its first four rows and columns, so that its blocks are new ones, is
  compressed again with its own tables and sampling of colours. The difference is then resized as the photo is.
- the model: the differences from the photos, of training and test, which no arithmetic removes.
"""

import io
import math
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, Gaussians, rasterize
from PIL import Image, JpegImagePlugin
from torch import Tensor
from tqdm import tqdm

from benchmarks.accuracy.sampled_pixels import blended, layers, random_pixels, sorted_view
from benchmarks.accuracy.trained_models import TrainedModel, model_parser, trained
from benchmarks.harness.measuring import chosen_device, describe, print_table
from benchmarks.workloads.splat_scenes import PARAMETERS, on_device
from scene.cameras import Camera
from utils.system_utils import atomic_write, run_cli

VIEWS, PIXELS = 8, 500  # of a model, and of a view
STEPS = 255
NO_CUT = 1e-12  # an alpha that cannot be seen
ARITHMETIC, RAYS, OUTPUT = "float32 arithmetic", "EWA against rays", "8-bit output"
CUT_ALPHA, CUT_LEFT, ORDER = "cut at alpha 1/255", "cut at transmittance 1e-4", "order of means, not on rays"
JPEG, MODEL = "JPEG of the photos", "model against photos"


def tf32(values: Tensor) -> Tensor:
    """float32 values rounded to the 10 bits of TF32's mantissa, half to even."""
    bits = values.contiguous().view(torch.int32)
    return ((bits + 0xFFF + ((bits >> 13) & 1)) & ~0x1FFF).view(torch.float32)


FORMATS: dict[str, Callable[[Tensor], Tensor]] = {
    "TF32": tf32,
    "half": lambda values: values.half().float(),
    "bfloat16": lambda values: values.bfloat16().float(),
}


def drawn(
    gaussians: Gaussians, camera: GaussianRasterizationSettings, pixels: Tensor, dtype: torch.dtype, **changed: Tensor
) -> Tensor:
    """Colours (P, 3), float64 on the CPU, at pixels of the image that the kernels draw in a dtype."""
    values = {name: t.to(dtype) for name, t in (gaussians._asdict() | changed).items() if t is not None}
    means, opacities = values.pop("means"), values.pop("opacities")
    tensors = {name: t.to(dtype) for name, t in camera._asdict().items() if isinstance(t, Tensor)}
    image = rasterize(means, torch.zeros_like(means), opacities, camera._replace(**tensors), raw=True, **values).color
    return image[:, pixels[:, 1], pixels[:, 0]].T.double().cpu()


def image_errors(model: TrainedModel, camera: GaussianRasterizationSettings, seed: int) -> Iterator[tuple[str, Tensor]]:
    """The name and the differences (P, 3) of each error at random pixels of a view; values of images are 0 to 1.

    The kernels' float64 runs on the CPU, all that is sampled on the model's device.
    """
    pixels = random_pixels(camera, PIXELS, seed)
    view = sorted_view(model.gaussians, camera, camera.projection)
    reaching = layers(view, pixels)
    colors, _ = blended(reaching, view.background)
    exact = colors.cpu().clamp(0, 1)
    host = Gaussians(*(None if values is None else values.cpu() for values in model.gaussians))
    double = partial(drawn, host, on_device(camera, "cpu"), pixels.cpu(), torch.float64)

    def error(found: Tensor) -> Tensor:
        return found.cpu().clamp(0, 1) - exact

    yield ARITHMETIC, error(drawn(model.gaussians, camera, pixels, torch.float32))
    for name, rounded in FORMATS.items():
        values = {tensor: rounded(getattr(host, tensor)) for tensor in PARAMETERS}
        for tensor in PARAMETERS:
            yield f"{name} {tensor}", error(double(**{tensor: values[tensor]}))
        yield f"{name} all", error(double(**values))
    yield CUT_ALPHA, error(blended(layers(view, pixels, NO_CUT), view.background)[0])
    yield CUT_LEFT, error(blended(reaching, view.background, stop=0.0)[0])
    other = sorted_view(model.gaussians, camera, "ewa" if camera.projection == "ray" else "ray")
    yield RAYS, error(blended(layers(other, pixels), view.background)[0])
    yield ORDER, error(blended(reaching, view.background, reaching.along)[0])
    yield OUTPUT, (exact * STEPS).round() / STEPS - exact


def photo_errors(
    model: TrainedModel, camera: GaussianRasterizationSettings, view: Camera
) -> Iterator[tuple[str, Tensor]]:
    """The same of a view's photo, at all its pixels."""
    noise = jpeg_noise(view.image_path, (view.image_width, view.image_height))
    if noise is not None:
        yield JPEG, noise
    target = view.target(camera.bg.float().to(view.device)).cpu()
    target = target.double() / (STEPS if target.dtype == torch.uint8 else 1)
    y, x = (t.reshape(-1) for t in torch.meshgrid(*(torch.arange(n) for n in target.shape[1:]), indexing="ij"))
    image = drawn(model.gaussians, camera, torch.stack([x, y], 1), torch.float32)
    yield MODEL, image.clamp(0, 1) - target[:, y, x].T


def jpeg_noise(path: Path, size: tuple[int, int]) -> Tensor | None:
    """What compressing a photo once more changes, at a size (width, height): (P, 3); None for another format."""
    with Image.open(path) as photo:
        if photo.format != "JPEG" or photo.mode != "RGB":
            return None
        tables, sampling = photo.quantization, JpegImagePlugin.get_sampling(photo)
        shifted = photo.crop((4, 4, *photo.size))
        share = [part / whole for part, whole in zip(shifted.size, photo.size, strict=True)]
    file = io.BytesIO()
    shifted.save(file, "JPEG", qtables=tables, subsampling=sampling)
    difference = (np.asarray(Image.open(file), np.float32) - np.asarray(shifted, np.float32)) / STEPS
    size = tuple(max(1, round(part * length)) for part, length in zip(share, size, strict=True))
    planes = [Image.fromarray(plane).resize(size, Image.Resampling.BICUBIC) for plane in difference.transpose(2, 0, 1)]
    return torch.from_numpy(np.stack([np.asarray(plane) for plane in planes], -1).reshape(-1, 3)).double()


def errors_of(model: TrainedModel) -> dict[str, float]:
    """The root mean square of each error over a model's views, steps of 8 bits."""
    squares: dict[str, list[Tensor]] = {}
    for place in tqdm(model.spread(VIEWS), desc=model.label, unit="view", leave=False):
        camera = model.cameras[place]
        found = list(image_errors(model, camera, seed=place))
        if model.views:
            found += photo_errors(model, camera, model.views[place])
        for name, differences in found:
            squares.setdefault(name, []).append(differences.square().mean())
    return {name: STEPS * float(torch.stack(values).mean().sqrt()) for name, values in squares.items()}


def together(found: dict[str, dict[str, float]], name: str) -> float:
    """The root mean square of an error over the models that have it."""
    values = [errors[name] for errors in found.values() if name in errors]
    return math.sqrt(sum(value * value for value in values) / len(values))


def psnr(rms: float) -> str:
    return f"{20 * math.log10(STEPS / rms):.1f}" if rms > 0 else "exact"


def ranked(found: dict[str, dict[str, float]]) -> list[str]:
    """The names of all errors, the largest first."""
    names = dict.fromkeys(name for errors in found.values() for name in errors)
    return sorted(names, key=partial(together, found), reverse=True)


def print_report(found: dict[str, dict[str, float]]) -> None:
    """Print the errors of each model, the largest first."""
    rows = []
    for name in ranked(found):
        row = [f"{errors[name]:.2g}" if name in errors else "" for errors in found.values()]
        rows.append([name, *row, f"{together(found, name):.2g}", psnr(together(found, name))])
    print_table(["error", *found, "all", "dB"], rows)


def draw(path: Path, found: dict[str, dict[str, float]], title: str) -> None:
    """Draw a bar for each error, the largest at the top, and a dot for each model."""
    from matplotlib.figure import Figure

    names = ranked(found)[::-1]
    figure = Figure(figsize=(10, 0.27 * len(names) + 1), layout="constrained")
    panel = figure.subplots()
    colors = ["#999999" if name.split()[0] in FORMATS else "#0072B2" for name in names]
    panel.barh(names, [together(found, name) for name in names], color=colors, height=0.7)
    for k, (label, errors) in enumerate(found.items()):
        places = [place for place, name in enumerate(names) if name in errors]
        dots = [errors[names[place]] for place in places]
        panel.plot(dots, places, "o", color=f"C{k + 1}", markersize=4, label=label, zorder=3)
    panel.axvline(1, color="black", linewidth=0.8)
    panel.set(xscale="log", xlabel="root mean square, steps of 8 bits", ylim=(-0.7, len(names) - 0.3))
    panel.grid(axis="x", alpha=0.3)
    panel.legend(fontsize="small", loc="lower right")
    panel.set_title(title, fontsize=8)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=80, metadata={"Software": None})


@torch.no_grad()
def main() -> None:
    args = model_parser(__doc__, figure=True).parse_args()
    device = chosen_device(args)
    machine, found = describe(device), {}
    print(machine)
    for word in args.models:
        model = trained(word, device)
        found[model.label] = errors_of(model)
    print(f"\nRMS in steps of 8 bits; {VIEWS} views of each model, {PIXELS} random pixels of each\n")
    print_report(found)
    if args.figure:
        draw(args.figure, found, machine)


if __name__ == "__main__":
    run_cli(main)
