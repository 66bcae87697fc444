"""Value of a finished model's unseen Gaussians and SH bands: bytes beside PSNR and the time of a render.

    python -m benchmarks.scenes.trimming -m MODEL

A model that train.py saved without --keep_unseen has no unseen Gaussians. The bound is that of --prune_sh, the largest
change of a colour. PSNR is the mean over the views, from unrounded renders.
"""

from collections.abc import Callable

import torch

from arguments import ModelParams, OptionParser, PipelineParams, get_combined_args
from benchmarks.harness.environment import describe, print_table
from benchmarks.harness.timing import cpu_milliseconds, gpu_time
from gaussian_renderer.scored_views import ScoredViews
from gaussian_renderer.trimming import decisive_for_any
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.gaussians.sh_bands import cut_bounds
from scene.saved_model import load_saved
from utils.system_utils import compute_device, run_cli


def milliseconds(run: Callable[[], object], device: torch.device) -> float:
    """Return the median wall time of a call."""
    return gpu_time(run).wall if device.type == "cuda" else cpu_milliseconds(run, 9)


@torch.no_grad()
def main() -> None:
    parser = OptionParser(description=__doc__.splitlines()[0])
    model_params, pipeline_params = ModelParams(parser, sentinel=True), PipelineParams(parser)
    parser.add_argument("--iteration", type=int, default=-1, help="saved iteration to load (-1: the highest)")
    args = get_combined_args(parser)
    options, pipe = model_params.extract(args), pipeline_params.extract(args)
    device = compute_device()
    print(describe(device))
    scene = load_saved(options, args.iteration, args.typed_sh_degree)
    gaussians = scene.gaussians
    background = torch.full((3,), 1.0 if options.white_background else 0.0, device=device)
    views = {"train": scene.getTrainCameras(), "test": scene.getTestCameras()}

    keep = decisive_for_any(views["train"], gaussians, pipe)
    views["train"] = [camera for camera in views["train"] if camera.columns is None]  # whole photos, no test views
    bounds = cut_bounds(gaussians.get_features_rest[keep])
    models = [("all", "", gaussians), ("without unseen", "0", gaussians.part(keep, gaussians.max_sh_degree))]
    for degree in reversed(range(gaussians.max_sh_degree)):
        models.append((f"and SH bands above {degree}", f"{bounds[degree]:.3g}", gaussians.part(keep, degree)))
    scored = ScoredViews(pipe, background, options.train_test_exp)
    rows = [[name, bound, *_row(model, views, scored, device)] for name, bound, model in models]
    header = ["saved", "bound", "Gaussians", "MB", "train PSNR", "test PSNR", "ms a view"]
    print_table(header, rows)


def _row(model: GaussianModel, views: dict[str, list[Camera]], scored: ScoredViews, device: torch.device) -> list[str]:
    psnr = []
    for cameras in views.values():
        scores = scored.scores(cameras, model)
        psnr.append(f"{scores['psnr']:.3f}" if scores else "")
    median = milliseconds(lambda: scored.image(views["train"][0], model), device)
    return [str(len(model)), f"{model.ply_bytes / 1e6:.2f}", *psnr, f"{median:.2f}"]


if __name__ == "__main__":
    run_cli(main)
