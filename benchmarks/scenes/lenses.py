"""Trainings of ray-traced fisheyes and panoramas, undistorted and native, scored on the photos as they are.

    python -m benchmarks.scenes.lenses OUT [OPTION of train.py ...]

Fisheyes are 200 degrees wide; of those, undistorted photos have the middle 120. Panoramas cannot be undistorted.
"""

import argparse
from pathlib import Path
from statistics import mean, stdev

from benchmarks.harness.measuring import describe, print_table
from benchmarks.scenes.training import COLUMNS, train
from splatting.demo.make_scene import make_scene
from utils.system_utils import compute_device, run_cli

_VIEWS, _POINTS = 48, 8000
_SIZES = {"fisheye": (240, 180), "panorama": (384, 192)}
_CASES = (("fisheye", "undistort"), ("fisheye", "native"), ("panorama", "native"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="new folder for the scenes and the models")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="default: 0 1 2")
    args, options = parser.parse_known_args()
    out = args.out.resolve()
    for camera, size in _SIZES.items():
        make_scene(out / camera, _VIEWS, *size, _POINTS, seed=0, camera=camera)
    print(describe(compute_device()), "\ntrain.py --eval", *options, flush=True)
    rows = []
    for camera, lenses in _CASES:
        runs = [
            train(
                out / camera,
                out / f"{camera}_{lenses}_{seed}",
                seed,
                ["--lenses", lenses, *options],
                shown=("--lenses", "native"),
            )
            for seed in args.seeds
        ]
        values = {key: [run[key] for run in runs] for key in COLUMNS}
        spread = f" ({stdev(values['PSNR']):.2f})" if len(runs) > 1 else ""
        cells = [f"{mean(values[key]):{form}}" + (spread if key == "PSNR" else "") for key, form in COLUMNS.items()]
        rows.append([camera, lenses, *cells])
    print_table(["camera", "lenses", "training s", "process s", "PSNR dB", "SSIM", "Gaussians"], rows)


if __name__ == "__main__":
    run_cli(main)
