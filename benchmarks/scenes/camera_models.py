"""Quality of training with every camera model of pycolmap, each beside its pinhole twin.

    python -m benchmarks.scenes.camera_models OUT [--models OPENCV FOV ...] [--iterations 7000]

The scene is ray-traced through each exact lens from known positions. The twin is traced through the same pinhole that
the photos of the lens are undistorted to. Both trainings start from the same points. PSNR is that of metrics.py on
held-out views: each model's renders against its own photos, and the lens's renders against the twin's photos, which no
undistortion has smoothed.
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image
from tqdm import tqdm

import metrics
from benchmarks.harness.environment import describe, print_table
from benchmarks.scenes.training import train
from benchmarks.workloads.lenses import DISTORTED, LensView, colmap_camera, make_lens
from demo.colmap_model import write_model
from demo.objects import demo_scene
from demo.surface_points import SurfacePoints, sample_points
from demo.tracer import View, render_view
from demo.views import ring_views
from scene.pictures.lens import Lens, undistortion
from scene.pictures.pycolmap_import import import_pycolmap
from utils.system_utils import UserError, compute_device, run_cli

FOCAL = 0.75  # in image widths


def through(views: list[View], lens: Lens) -> list[LensView]:
    """Return the views from the same positions through a lens."""
    return [LensView(view.rotation, view.center, view.focal, lens.width, lens.height, lens) for view in views]


def write_scene(
    folder: Path, views: list[LensView], points: SurfacePoints | None, rng: np.random.Generator, count: int
):
    """Ray-trace the views and write them as a COLMAP scene.

    Returns the scene's points: `points`, or if that is None new ones from `count` tries.
    """
    names = [f"view_{index:03d}.png" for index in range(len(views))]
    pictures = [render_view(demo_scene(), view) for view in tqdm(views, desc=folder.name, unit="view", leave=False)]
    (folder / "images").mkdir(parents=True)
    for name, picture in zip(names, pictures, strict=True):
        Image.fromarray(picture).save(folder / "images" / name)
    points = points or sample_points(demo_scene(), views, pictures, count, rng)
    sparse = folder / "sparse" / "0"
    write_model(sparse, names, views, points)
    model = import_pycolmap().Reconstruction(str(sparse))
    lens = colmap_camera(views[0].lens)
    model.cameras[1].model, model.cameras[1].params = lens.model, lens.params
    model.cameras[1].width, model.cameras[1].height = lens.width, lens.height
    model.write_binary(str(sparse))
    return points


def psnr_against(renders: Path, truths: Path) -> float:
    """Return the mean PSNR, dB, of the renders of one model against the ground truth of another."""
    pairs = [[np.asarray(Image.open(folder / file.name)) for folder in (renders, truths)] for file in renders.iterdir()]
    return float(np.mean([metrics.psnr(*pair) for pair in pairs]))


def compare(name: str, out: Path, args: argparse.Namespace, options: list[str]) -> list[str]:
    """Train lens and twin of one camera model and return the model's row of the table."""
    width, height = args.size
    rng = np.random.default_rng(0)
    places = ring_views(args.views, width, height, rng)
    lens = make_lens(name, FOCAL * width, width, height)
    pinhole = undistortion(lens, width, height).pinhole
    twin = Lens("PINHOLE", pinhole[:4], pinhole.width, pinhole.height)
    points = write_scene(out / name / "twin", through(places, twin), None, rng, args.points)
    write_scene(out / name / "lens", through(places, lens), points, rng, args.points)
    scores = {side: train(out / name / side, out / name / f"{side}_model", 0, options) for side in ("lens", "twin")}
    last = next((out / name / "lens_model" / "test").iterdir())
    sharp = psnr_against(last / "renders", out / name / "twin_model" / "test" / last.name / "gt")
    difference = scores["lens"]["PSNR"] - scores["twin"]["PSNR"]
    return [
        name, f"{pinhole.width}x{pinhole.height}", f"{scores['lens']['PSNR']:.2f}", f"{scores['twin']['PSNR']:.2f}",
        f"{difference:+.2f}", f"{sharp:.2f}", f"{sharp - scores['twin']['PSNR']:+.2f}",
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="new folder for scenes and models")
    parser.add_argument("--models", nargs="+", default=DISTORTED, metavar="NAME", help="camera models (default: all)")
    parser.add_argument("--views", type=int, default=60, help="photos per scene (default: 60)")
    parser.add_argument("--size", type=int, nargs=2, default=(400, 300), metavar=("W", "H"), help="pixels (400 300)")
    parser.add_argument("--points", type=int, default=8000, help="surface points to try (default: 8000)")
    args, options = parser.parse_known_args()
    unknown = [name for name in args.models if name not in DISTORTED]
    if unknown:
        raise UserError(f"{unknown[0]} is not a camera model with distortion; choose from {', '.join(DISTORTED)}")
    if args.out.exists():
        raise UserError(f"{args.out} exists; name a new folder")
    rows = [compare(name, args.out, args, options) for name in args.models]
    print(describe(compute_device()))
    print(
        f"train.py {' '.join(options)}; {args.views} views of {args.size[0]}x{args.size[1]} pixels, every 8th held out"
    )
    header = [
        "camera model",
        "undistorted",
        "PSNR",
        "of its twin",
        "difference",
        "on the twin's photos",
        "difference",
    ]
    print_table(header, rows)


if __name__ == "__main__":
    run_cli(main)
