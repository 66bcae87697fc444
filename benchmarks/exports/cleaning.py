"""Effects of `export.py --clean`: Gaussians removed, of floaters put in by hand and of the rest, and loss of views.

    python -m benchmarks.exports.cleaning -m MODEL --floaters 0 200

Floaters are Gaussians of any colour between the training cameras and the point that they look at. PSNR, dB, against the
photos: training views in the mean, the one that loses most, and test views, each before and by how much it changes.
"""

import time
from dataclasses import replace

import numpy as np
import torch

from applications.export.cleaning import Cleaning, clean
from arguments import ModelParams, OptionParser, PipelineParams, get_combined_args
from benchmarks.harness.measuring import describe_machine, print_table
from gaussian_renderer.camera_paths.poses import Poses, focus_point, poses_of
from gaussian_renderer.scored_views import ScoredViews
from scene.saved_model import load_saved
from scene.splats.splats import Splats
from scene.with_splats import model_of, splats_of
from utils.system_utils import UserError, compute_device, run_cli

_PLACES = (0.25, 0.6)  # of the way from a camera to the point
_ASIDE = 0.15  # standard deviation across, in mean distances of the cameras, as the next
_SIZES = (0.005, 0.02)


def with_floaters(splats: Splats, poses: Poses, count: int, opacity: float, seed: int = 0) -> Splats:
    """The splats, and after them round floaters. UserError if the cameras look at no common point."""
    point, rng = focus_point(poses), np.random.default_rng(seed)
    if point is None:
        raise UserError("the cameras look at no common point; take a scene that they go around")
    unit = np.linalg.norm(poses.positions - point, axis=1).mean()
    places, way = poses.positions[rng.integers(0, len(poses), count)], rng.uniform(*_PLACES, (count, 1))
    sh = np.zeros((count, *splats.sh.shape[1:]))
    sh[:, 0] = rng.normal(size=(count, 3))
    added = {
        "means": (1 - way) * places + way * point + rng.normal(scale=_ASIDE * unit, size=(count, 3)),
        "log_scales": np.log(unit * rng.uniform(*_SIZES, (count, 3))),
        "rotations": np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        "opacity_logits": np.full(count, np.log(opacity / (1 - opacity))),
        "sh": sh,
    }
    both = {name: np.concatenate([getattr(splats, name), values], dtype=np.float32) for name, values in added.items()}
    return replace(splats, **both)


def losses(cleaning: Cleaning) -> np.ndarray:
    """PSNR before minus after of each training view, dB."""
    return np.array([score - cleaning.after[view] for view, score in cleaning.before.items()])


def main() -> None:
    """Print what --clean removes with and without added floaters, and how the views change."""
    parser = OptionParser(description=__doc__.splitlines()[0])
    models, pipelines = ModelParams(parser, sentinel=True), PipelineParams(parser, sentinel=True)
    parser.add_argument("--floaters", type=int, nargs="+", default=[0, 200], help="how many (default: 0 200)")
    parser.add_argument("--opacity", type=float, default=0.6, help="of the floaters (default: 0.6)")
    parser.add_argument("--db", type=float, nargs="+", default=[0.05], help="values of --clean (default: 0.05)")
    args = get_combined_args(parser)
    options = models.extract(args)
    scene, rows = load_saved(options, -1), []
    background = torch.full((3,), float(options.white_background), device=compute_device())
    views = ScoredViews(pipelines.extract(args), background, scene.halves)
    train, test, splats = (
        scene.getTrainCameras(),
        scene.getTestCameras(),
        splats_of(scene.gaussians, bool(args.antialiasing)),
    )
    for count in args.floaters:
        model = model_of(with_floaters(splats, poses_of(train), count, args.opacity))
        scores = [views.scores(cameras, model).get("psnr", np.nan) for cameras in (train, test)]
        for most in args.db:
            start = time.perf_counter()
            cleaning = clean(model, train, views, most)
            seconds, gone, lost = time.perf_counter() - start, ~cleaning.keep.cpu().numpy(), losses(cleaning)
            after = views.scores(test, model.part(cleaning.keep, model.max_sh_degree)).get("psnr", np.nan)
            numbers = [f"{scores[0]:.2f} {-lost.mean():+.3f}", f"{-lost.max():+.3f}"]
            numbers.append(f"{scores[1]:.2f} {after - scores[1]:+.3f}")
            gone_of = f"{gone[:-count].sum() if count else gone.sum():,} of {len(splats):,}"
            rows.append([f"{most:g}", f"{gone[len(splats) :].sum()} of {count}", gone_of, *numbers, f"{seconds:.1f}"])
    print(describe_machine(compute_device()))
    print_table(["--clean", "floaters gone", "others gone", "training", "worst", "test", "seconds"], rows)


if __name__ == "__main__":
    run_cli(main)
