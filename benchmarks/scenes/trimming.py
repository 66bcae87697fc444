"""Value of a finished model's unseen Gaussians and SH bands: bytes beside PSNR and the time of a render.

    python -m benchmarks.scenes.trimming -m MODEL
    python -m benchmarks.scenes.trimming --scenes SCENE ... --out OUT [--at N ...] [--write docs/results/costs.md]

A model that train.py saved without --keep_unseen has no unseen Gaussians. The bound is that of --prune_sh, the largest
change of a colour. PSNR is the mean over the views, from unrounded renders.

With --scenes, each scene is trained with --eval --keep_unseen --prune_sh -1, and saved at each iteration N. All other
options (-r 4) go to train.py. Models are kept in OUT; one that is there already is not trained again. The table
compares three rules for the Gaussians to leave out: those that no training view depends on, those that no view between
neighbours depends on either, and what train.py does at its end. A cell has the share left out, the largest change of
a value of a test view (of 255), and the change of PSNR in dB.
"""

import argparse
import time
from collections.abc import Callable
from itertools import chain
from pathlib import Path

import torch
from torch import Tensor

from arguments import ModelParams, OptionParser, PipelineParams, get_combined_args, read_cfg_args
from benchmarks.harness.environment import describe, print_table, table
from benchmarks.harness.page import check_marks, write_tables
from benchmarks.harness.timing import cpu_milliseconds, gpu_time
from benchmarks.scenes.training import run
from gaussian_renderer.between import neighbours, views_between
from gaussian_renderer.scored_views import ScoredViews
from gaussian_renderer.trimming import change_on_views, decisive_for_any, search_unseen
from scene import Scene
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.gaussians.sh_bands import cut_bounds, needed_degree
from scene.saved_model import load_saved
from utils.system_utils import UserError, compute_device, run_cli

PART = "omission"  # of the page


def milliseconds(call: Callable[[], object], device: torch.device) -> float:
    """Return the median wall time of a call."""
    return gpu_time(call).wall if device.type == "cuda" else cpu_milliseconds(call, 9)


def compare_models(options: argparse.Namespace, pipe: argparse.Namespace, scene: Scene) -> None:
    """Print bytes, PSNR and milliseconds of a model, without unseen Gaussians, and with fewer and fewer bands."""
    device, gaussians = compute_device(), scene.gaussians
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


def trained(source: Path, out: Path, iterations: list[int], options: list[str]) -> Path:
    """Train a scene, unless OUT has its model; return the model's folder."""
    model = out / source.name
    if not (model / "point_cloud" / f"iteration_{iterations[-1]}").is_dir():
        white = ["-w"] if (source / "transforms_train.json").is_file() else []
        command = [
            "-s",
            source,
            "-m",
            model,
            "--eval",
            "--iterations",
            iterations[-1],
            "--save_iterations",
            *iterations,
        ]
        command += ["--keep_unseen", "--prune_sh", -1, "--test_iterations", -1, "--no_curve", *white, *options]
        run("train.py", *map(str, command))
    return model


def _load(model: Path, iteration: int) -> tuple[argparse.Namespace, argparse.Namespace, Scene]:
    """Read the options of a model folder, and load its scene and a saved iteration."""
    parser = argparse.ArgumentParser()
    groups = ModelParams(parser), PipelineParams(parser)
    args = parser.parse_args([])
    stored = read_cfg_args(model) | {"model_path": str(model)}
    args = argparse.Namespace(**vars(args) | stored)
    options, pipe = (group.extract(args) for group in groups)
    return options, pipe, load_saved(options, iteration)


def omission_row(model: Path, iteration: int) -> list[str]:
    """Measure on the test views what each rule changes; return the cells of a row of the table."""
    options, pipe, scene = _load(model, iteration)
    gaussians, cameras, test = scene.gaussians, scene.getTrainCameras(), scene.getTestCameras()
    background = torch.full((3,), 1.0 if options.white_background else 0.0, device=compute_device())
    scored = ScoredViews(pipe, background, options.train_test_exp)

    def effect(keep: Tensor) -> str:
        part = gaussians.part(keep, gaussians.max_sh_degree)
        change = change_on_views(gaussians, part, test, scored, scored=True)
        share = 100 * (1 - len(part) / len(gaussians))
        lost = change["psnr_after"] - change["psnr_before"]
        return f"{share:.2f} %, {255 * change['largest']:.2f}, {lost:+.4f}"

    start = time.perf_counter()
    photographed = decisive_for_any(cameras, gaussians, pipe)
    seconds = [time.perf_counter() - start]
    pairs = neighbours(cameras)
    between = list(chain.from_iterable(views_between(cameras[i], cameras[j]) for i, j in pairs))
    walked = photographed | decisive_for_any(between, gaussians, pipe)
    seconds.append(time.perf_counter() - start)
    search = search_unseen(gaussians, cameras, pipe, iteration)
    bounds = cut_bounds(gaussians.get_features_rest[search.keep])
    saved = gaussians.part(search.keep, needed_degree(bounds, 0.0))
    return [
        f"{model.name}, {iteration:,}",
        f"{len(gaussians):,}",
        effect(photographed),
        effect(walked),
        f"{seconds[0]:.1f}, {seconds[1]:.1f} ({len(cameras)}, {len(cameras) + len(between)})",
        effect(search.keep),
        search.end,
        f"{gaussians.ply_bytes / 1e6:.2f}, {saved.ply_bytes / 1e6:.2f} (degree {saved.max_sh_degree})",
    ]


OMISSION = [
    "scene, iterations", "Gaussians", "no training view", "nor a view between", "seconds of these two (views)",
    "as train.py does", "its search", "MB of all, saved",
]  # fmt: skip


def compare_scenes(args: argparse.Namespace, rest: list[str]) -> None:
    """Train the scenes, print the table of omission, and write it into a page if one is named."""
    if args.out is None:
        raise UserError("--scenes needs --out, the folder for the models")
    if args.write:
        check_marks(args.write, PART)
    rows = []
    for source in args.scenes:
        model = trained(source.resolve(), args.out.resolve(), sorted(args.at), rest)
        for iteration in sorted(args.at):
            rows.append(omission_row(model, iteration))
            print(" | ".join(rows[-1]), flush=True)
    lines = ["", describe(compute_device()), "", *table(OMISSION, rows), ""]
    print("\n".join(lines))
    if args.write:
        write_tables(args.write, PART, lines)


def _of_scenes() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--scenes", type=Path, nargs="+", help="scenes to train and compare, instead of a model")
    parser.add_argument("--out", type=Path, help="folder for the models of --scenes")
    parser.add_argument("--at", type=int, nargs="+", default=[600, 2000], help="iterations to compare (600 2000)")
    parser.add_argument("--write", type=Path, help="page whose table of omission to replace (default: only print)")
    return parser


@torch.no_grad()
def main() -> None:
    args, rest = _of_scenes().parse_known_args()
    if args.scenes:
        compare_scenes(args, rest)
        return
    parser = OptionParser(description=__doc__.splitlines()[0], parents=[_of_scenes()])
    model_params, pipeline_params = ModelParams(parser, sentinel=True), PipelineParams(parser)
    parser.add_argument("--iteration", type=int, default=-1, help="saved iteration to load (-1: the highest)")
    args = get_combined_args(parser)
    options, pipe = model_params.extract(args), pipeline_params.extract(args)
    print(describe(compute_device()))
    compare_models(options, pipe, load_saved(options, args.iteration, args.typed_sh_degree))


if __name__ == "__main__":
    run_cli(main)
