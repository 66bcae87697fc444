"""Share of a model's instances (a splat in a tile) that are hidden because the tile is opaque in front of them.

    python -m benchmarks.kernels.hidden_instances -m MODEL [--iteration N]

Counts the instances of each training view, the processed ones, and the splats that have a processed instance. Those up
to the last one that a pixel of the tile blends are processed. The rest is the most that a depth cut-off per tile could
save. Prints medians over the views.
"""

from statistics import median

import torch
from tqdm import tqdm

from arguments import ModelParams, OptionParser, get_combined_args
from benchmarks.harness.environment import describe, print_table
from benchmarks.kernels.fragments import processed_per_tile
from benchmarks.kernels.views import view_arguments
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.saved_model import load_saved
from utils.system_utils import compute_device, run_cli


def counts(camera: Camera, model: GaussianModel) -> dict[str, int]:
    """Count the splats and instances that one view lists, and those of them that are processed."""
    means, background = model.get_xyz, model.get_xyz.new_zeros(3)
    arguments = view_arguments(camera, model)
    out = torch.ops.diff_gaussian_rasterization.rasterize(means, *arguments, background, False, True)
    _, _, _, _, _, tile_counts, instances, ranges, _, _, last, _ = out
    processed = processed_per_tile(last)
    tile = torch.repeat_interleave(torch.arange(len(processed), device=ranges.device), ranges.diff())
    behind = torch.arange(len(instances), device=ranges.device) - ranges[tile] >= processed[tile]
    return {
        "splats": int((tile_counts > 0).sum()),
        "splats processed": len(instances[~behind].unique()),
        "instances": len(instances),
        "instances processed": int(processed.sum()),
    }


@torch.no_grad()
def main() -> None:
    parser = OptionParser(description=__doc__.splitlines()[0])
    model_params = ModelParams(parser, sentinel=True)
    parser.add_argument("--iteration", type=int, default=-1, help="saved iteration to load (-1: the highest)")
    args = get_combined_args(parser)
    print(describe(compute_device()))
    scene = load_saved(model_params.extract(args), args.iteration, args.typed_sh_degree)
    views = [counts(camera, scene.gaussians) for camera in tqdm(scene.getTrainCameras(), unit="view")]
    totals = {name: median(view[name] for view in views) for name in views[0]}
    rows = [
        [what, f"{totals[what]:,.0f}", f"{median(v[f'{what} processed'] / max(v[what], 1) for v in views):.3f}"]
        for what in ("splats", "instances")
    ]
    print_table([f"{scene.model_path}, {len(scene.gaussians):,} Gaussians", "a view lists", "processed"], rows)


if __name__ == "__main__":
    run_cli(main)
