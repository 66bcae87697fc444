"""A large set of photos: time to the first iteration and peak memory, with and without --images_to_load.

    python -m benchmarks.scenes.large_set [--views 2000] [--images_to_load 100]

Makes a COLMAP scene in a temporary folder: smooth noise as JPEGs, cameras on a ring, points in the middle. Trains one
epoch three times: with all images in memory, with at most N, and with at most N and no decoding ahead. The files were
just written, so they are read from the system's cache.
"""

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import Image
from tqdm import tqdm

from benchmarks.harness.environment import describe, print_table
from utils.system_utils import UserError, compute_device, run_cli

ROOT = Path(__file__).resolve().parents[2]

POINTS = 5000
RADIUS = 4.0  # of the ring, world units


def make_scene(folder: Path, views: int, size: tuple[int, int]) -> None:
    """Write a COLMAP model as text, and JPEGs of smooth noise, each with other values."""
    width, height = size
    rng = np.random.default_rng(0)
    (folder / "images").mkdir(parents=True)
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    poses = []
    for index in tqdm(range(views), desc="Making photos", unit="photo"):
        coarse = rng.integers(0, 256, (-(-height // 16), -(-width // 16), 3), dtype=np.uint8)
        Image.fromarray(coarse).resize(size).save(folder / "images" / f"{index:05d}.jpg", quality=90)
        # Turn about the vertical axis; the centre of the ring is always RADIUS in front of the camera.
        half = math.pi * index / views
        poses.append(f"{index + 1} {math.cos(half)} 0 {math.sin(half)} 0 0 0 {RADIUS} 1 {index:05d}.jpg\n\n")
    (sparse / "cameras.txt").write_text(f"1 PINHOLE {width} {height} {width} {width} {width / 2} {height / 2}\n")
    (sparse / "images.txt").write_text("".join(poses))
    points = 0.6 * rng.normal(size=(POINTS, 3))
    (sparse / "points3D.txt").write_text(
        "".join(f"{i + 1} {x:.6f} {y:.6f} {z:.6f} 128 110 90 0.5\n" for i, (x, y, z) in enumerate(points))
    )


def train(scene: Path, model: Path, options: list[str], ahead: bool) -> dict[str, float]:
    """Train once; return seconds and peaks in bytes.

    Keys: `first`, seconds from the start of the process to the end of iteration 1; `training` and `process`, seconds of
    the training and of the whole process; `peak` and `gpu`, peaks of host and GPU memory.
    """
    command = ["-s", str(scene), "-m", str(model), "--test_iterations", "-1", *options]
    said, started = model.with_suffix(".json"), time.time()
    child = [sys.executable, "-m", "benchmarks.scenes.first_iteration", str(started), str(said)]
    child += [] if ahead else ["--not_ahead"]
    done = subprocess.run([*child, *command], cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        raise UserError(f"train.py {' '.join(command)} failed:\n{(done.stdout + done.stderr)[-4000:]}")
    result = json.loads(said.read_text())
    seconds = json.loads((model / "train_log.json").read_text())[-1]["seconds"]
    return result | {"training": seconds, "process": time.time() - started}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=int, default=2000, help="photos (default: 2000)")
    parser.add_argument("--size", type=int, nargs=2, default=[1280, 720], metavar=("W", "H"),
                        help="size of the photos in pixels (default: 1280 720)")  # fmt: skip
    parser.add_argument("--width", type=int, default=320, help="width to train at, -r (default: 320)")
    parser.add_argument("--images_to_load", type=int, default=100, help="limit of images in memory (default: 100)")
    args = parser.parse_args()
    print(describe(compute_device()))
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene"
        make_scene(scene, args.views, tuple(args.size))
        options = ["-r", str(args.width), "--iterations", str(args.views), "--densify_from_iter", str(args.views)]
        limit = ["--images_to_load", str(args.images_to_load)]
        for name, more, ahead in (
            ("all kept", [], True),
            (f"at most {args.images_to_load}", limit, True),
            (f"at most {args.images_to_load}, none decoded ahead", limit, False),
        ):
            result = train(scene, Path(folder) / name.replace(" ", "_"), options + more, ahead)
            rows.append([name, *(f"{result[key]:.1f}" for key in ("first", "training", "process"))])
            rows[-1] += [f"{result[key] / 2**20:.0f}" for key in ("peak", "gpu")]
    print_table(
        ["images", "to the first iteration s", "an epoch s", "process s", "peak memory MiB", "of the GPU MiB"], rows
    )


if __name__ == "__main__":
    run_cli(main)
