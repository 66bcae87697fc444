"""Trainings of a ray-traced street of 200 views, with blocks that sleep and without, by turns over three seeds.

    python -m benchmarks.scenes.street OUT [OPTION of train.py ...]

A row of houses stands on each side; the cameras walk along the street and look ahead, back and to the sides, so that a
view sees a small part of it. Without sleep is `MOST_SHARE = 0` in scene/sleeping.py.
"""

import argparse
import json
from pathlib import Path
from statistics import mean, stdev

import numpy as np

from benchmarks.harness.measuring import describe, print_table
from benchmarks.scenes.training import run, seconds_of
from splatting.demo.make_scene import write_scene
from splatting.demo.objects import Box, Ground, Sphere, Thing, backdrop_texture, ground_texture, marble, panels, stripes
from splatting.demo.tracer import View, look_at
from utils.system_utils import compute_device, run_cli

_VIEWS, _POINTS = 200, 20_000
_LENGTH, _HOUSES, _HALF_WIDTH = 60.0, 20, 4.0  # of the street in world units, on each side, to a house
_SAMPLES = 2  # rays of a pixel in each direction
_CHILD = """
import sys
import scene.sleeping as sleeping
sleeping.MOST_SHARE, shares, wake = float(sys.argv.pop(1)), [], sleeping.Sleeping.wake

def noted(self, *arguments):
    awake = wake(self, *arguments)
    shares.append(float(self.awake.float().mean()))
    return awake

if sys.argv.pop(1) == "cpu":  # a GPU's graphs call no Python
    sleeping.Sleeping.wake = noted
import train
train.main(sys.argv[1:])
with open(sys.argv[sys.argv.index("-m") + 1] + "/awake.txt", "w") as file:
    file.write(str(sum(shares) / len(shares) if shares else 1.0))
"""


def street(_: int | None = None) -> list[Thing]:
    """The houses, the ground and the sky."""
    rng, things = np.random.default_rng(0), []
    for k in range(2 * _HOUSES):
        side, along = 1 if k % 2 else -1, _LENGTH * ((k // 2 + 0.5) / _HOUSES - 0.5)
        high, deep = rng.uniform(1.2, 2.6), rng.uniform(0.8, 1.2)
        box = Box(
            (side * (_HALF_WIDTH + deep), -high, along), (deep, high, rng.uniform(0.9, 1.4)), rng.uniform(-0.1, 0.1)
        )
        light, dark = (rng.uniform(*of, (3, 1)).astype(np.float32) for of in ((0.5, 0.95), (0.1, 0.5)))
        textures = panels(box), marble(light, dark, k), stripes(1, rng.uniform(4, 9), light, dark)
        things.append(Thing(box, textures[k % 3]))
    sky = Thing(Sphere((0, 0, 0), 80.0, inside=True), backdrop_texture, emissive=True)
    return [sky, Thing(Ground(80.0), ground_texture), *things]


def walk(width: int, height: int) -> list[View]:
    """The cameras, in their order along the street."""
    rng, views = np.random.default_rng(1), []
    for k in range(_VIEWS):
        center = np.array([rng.uniform(-1.5, 1.5), rng.uniform(-1.9, -1.3), _LENGTH * ((k + 0.5) / _VIEWS - 0.5)])
        turn = (0.0, 0.6, np.pi, 0.6 - np.pi)[k % 4] * (1 if k % 8 < 4 else -1) + rng.uniform(-0.2, 0.2)
        target = center + [np.sin(turn), rng.uniform(0.0, 0.15), np.cos(turn)]
        views.append(View(look_at(center, target), center, 0.8 * width, width, height))
    return views


def train(scene: Path, out: Path, seed: int, most_share: float, options: list[str]) -> dict[str, float]:
    """Train, render and score: seconds, test PSNR, the share awake, and the number of Gaussians."""
    model = ["-m", str(out)]
    words = ["-s", str(scene), *model, "--eval", "--seed", str(seed), "--no_curve", *options]
    run("-c", _CHILD, str(most_share), compute_device().type, *words)
    run("render.py", *model, "--skip_train")
    run("metrics.py", *model)
    (scores,) = json.loads((out / "results.json").read_text()).values()
    count = json.loads((out / "train_log.json").read_text())[-1]["gaussians"]
    awake = float((out / "awake.txt").read_text())
    return {"seconds": seconds_of(out), "PSNR": scores["PSNR"], "awake": awake, "Gaussians": count}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="new folder for the scene and the models")
    parser.add_argument("--size", type=int, nargs=2, default=(320, 200), help="of the photos (default: 320 200)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="default: 0 1 2")
    args, options = parser.parse_known_args()
    write_scene(args.out / "scene", walk(*args.size), street, _POINTS, np.random.default_rng(2), _SAMPLES)
    print(describe(compute_device()), "\ntrain.py --eval --no_curve", *options, flush=True)
    runs: dict[str, list[dict[str, float]]] = {"others asleep": [], "all awake": []}
    for seed in args.seeds:
        for (name, found), most in zip(runs.items(), (0.7, 0.0), strict=True):
            found.append(train(args.out / "scene", args.out / f"{name}_{seed}", seed, most, options))
            print(seed, name, found[-1], flush=True)
    rows = []
    for name, found in runs.items():
        psnr = [run["PSNR"] for run in found]
        spread = stdev(psnr) if len(psnr) > 1 else 0.0
        seconds, awake, count = (mean(run[key] for run in found) for key in ("seconds", "awake", "Gaussians"))
        rows.append(
            [
                name,
                f"{awake:.0%}" if awake < 1 or name == "all awake" else "",
                f"{seconds:.1f}",
                f"{mean(psnr):.2f} ({spread:.2f})",
                f"{count:,.0f}",
            ]
        )
    print_table(["blocks", "awake", "training s", "test PSNR dB", "Gaussians"], rows)


if __name__ == "__main__":
    run_cli(main)
