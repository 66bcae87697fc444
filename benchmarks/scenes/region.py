"""Test PSNR of the pixels that see a region and of the others, of models with and without `train.py --region`.

    python -m benchmarks.scenes.region MODEL... [--region auto]

Means over the test views, dB; their shares of pixels; and Gaussians, those in the region beside all.
"""

import math

import torch
from torch import Tensor

from arguments import ModelParams, OptionParser, PipelineParams, get_combined_args
from benchmarks.harness.measuring import describe, print_table
from gaussian_renderer import render
from scene.saved_model import load_saved
from splatting.parts.region.part import numbers_of
from splatting.parts.region.shape import found
from utils.image_utils import as_float
from utils.system_utils import compute_device, run_cli


def _psnr(error: Tensor, mask: Tensor) -> float | None:
    """Of an image's squared errors (3, H, W) where a mask (1, H, W) is set; None if that is nowhere."""
    if not mask.any():
        return None
    return -10 * math.log10((error * mask).double().sum().item() / (3 * mask.sum().item()))


@torch.no_grad()
def row_of(folder: str, region: str) -> list[str]:
    """A model's row of the table."""
    parser = OptionParser()
    models, pipelines = ModelParams(parser, sentinel=True), PipelineParams(parser, sentinel=True)
    args = get_combined_args(parser, ["-m", folder])
    options, pipe = models.extract(args), pipelines.extract(args)
    scene = load_saved(options, -1)
    shape, gaussians = found(numbers_of(region), scene), scene.gaussians
    background = torch.full((3,), float(options.white_background), device=compute_device())
    scores, share = ([], []), 0.0
    for camera in scene.getTestCameras():
        image = render(camera, gaussians, pipe, background)["render"].clamp(0, 1)
        error, seen = (image - as_float(camera.ground_truth(background)[0])).square(), shape.seen(camera)
        share += seen.double().mean().item() / len(scene.getTestCameras())
        for found_scores, mask in zip(scores, (seen, ~seen), strict=True):
            if (score := _psnr(error, mask)) is not None:
                found_scores.append(score)
    means = [f"{sum(each) / len(each):.2f}" if each else "none" for each in scores]
    inside = int(shape.holds(gaussians.get_xyz).sum())
    return [folder, *means, f"{100 * share:.0f} %", f"{inside:,} of {len(gaussians):,}"]


def main() -> None:
    parser = OptionParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", nargs="+", metavar="MODEL", help="folders that train.py wrote with --eval")
    parser.add_argument("--region", default="auto", help="as of train.py (default: auto)")
    args = parser.parse_args()
    rows = [row_of(folder, args.region) for folder in args.models]
    print(describe(compute_device()))
    print_table(["model", "region", "others", "seen by", "Gaussians in it"], rows)


if __name__ == "__main__":
    run_cli(main)
