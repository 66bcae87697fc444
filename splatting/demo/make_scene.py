"""Make the demo scene: ray-traced photos of analytic shapes, and a COLMAP model of them.

python -m splatting.demo.make_scene OUT [--views 60] [--size 400 300] [--points 8000] [--seed 0]
"""

from __future__ import annotations

import os
import shutil
from argparse import ArgumentParser
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from PIL import Image
from tqdm import tqdm

from splatting.demo.objects import demo_scene
from splatting.demo.points import MIN_TRACK, sample_points, write_model
from splatting.demo.tracer import View, render_view, ring_views
from splatting.host.threads import cores
from utils.system_utils import UserError, mkdir_p, run_cli

PIXELS_PER_PROCESS = 1_000_000  # with fewer, starting another process (2 s) costs more time than it saves


def _demo_picture(view: View) -> np.ndarray:
    return render_view(demo_scene(), view)


def _pictures(views: list[View]) -> list[np.ndarray]:
    """Ray-trace the views to photos, (H, W, 3) uint8 each, on several cores if that saves time."""
    pixels = sum(view.width * view.height for view in views)
    workers = min(cores(), 1 + pixels // PIXELS_PER_PROCESS)
    bar = partial(tqdm, total=len(views), desc="Ray tracing", unit="view")
    if workers == 1:
        return list(bar(map(_demo_picture, views)))
    # Use processes, because numpy holds the interpreter's lock most of the time on blocks this small.
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        return list(bar(pool.map(_demo_picture, views)))


def make_scene(out: Path, views: int, width: int, height: int, points: int, seed: int) -> int:
    """Write the scene to `out` (images/, sparse/0) and return its number of points.

    The same arguments give the same photos and points. `out` appears only when it is complete. UserError if it exists
    and is not empty, if it cannot be made, or if the scene would have no points.
    """
    out = out.resolve()
    if out == Path.cwd():
        raise UserError("the scene cannot replace the current folder; name a new folder")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"{out} exists and is not an empty folder; choose another one, or delete it first")
    rng = np.random.default_rng(seed)
    cameras = ring_views(views, width, height, rng)
    names = [f"view_{k:03d}.png" for k in range(views)]
    mkdir_p(out.parent)
    work = out.with_name(f".{out.name}.{os.getpid()}.tmp")
    try:
        (work / "images").mkdir(parents=True)
        pictures = _pictures(cameras)
        for name, picture in zip(names, pictures, strict=True):
            Image.fromarray(picture).save(work / "images" / name)
        cloud = sample_points(demo_scene(), cameras, pictures, points, rng)
        if not len(cloud.xyz):
            raise UserError(f"none of {points} points is visible in {MIN_TRACK} views; raise --points or --views")
        write_model(work / "sparse" / "0", names, cameras, cloud)
        if out.exists():
            out.rmdir()
        work.rename(out)
    except OSError as error:
        raise UserError(
            f"cannot write {out} ({error.strerror or error}); choose another place, or fix the permissions there"
        ) from error
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return len(cloud.xyz)


def main() -> None:
    parser = ArgumentParser(prog="python -m splatting.demo.make_scene", description="Make the ray-traced demo scene.")
    add = parser.add_argument
    add("out", type=Path, help="folder to make, with images/ and sparse/0")
    add("--views", type=int, default=60, help="number of photos, on three rings (60)")
    add("--size", type=int, nargs=2, default=(400, 300), metavar=("W", "H"),
        help="size of the photos in pixels (400 300)")  # fmt: skip
    add("--points", type=int, default=8000, help="surface points to try; a few are dropped (8000)")
    add("--seed", type=int, default=0, help="seed of the cameras' jitter and of the points (0)")
    args = parser.parse_args()
    for option, least in (("views", 3), ("size", 16), ("points", 1), ("seed", 0)):
        value = np.min(getattr(args, option))
        if value < least:
            raise UserError(f"--{option} must be at least {least}, got {value}")
    count = make_scene(args.out, args.views, *args.size, args.points, args.seed)
    print(f"{args.out}: {args.views} photos of {args.size[0]}x{args.size[1]} pixels, {count} points")


if __name__ == "__main__":
    run_cli(main)
