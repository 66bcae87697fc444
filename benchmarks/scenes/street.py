"""A ray-traced street of 200 views, each of which sees a small part of it, so that most blocks sleep.

    python -m benchmarks.scenes.street OUT

A row of houses stands on each side; the cameras walk along the street and look ahead, back and to the sides.
"""

import argparse
from pathlib import Path

import numpy as np

from splatting.demo.make_scene import write_scene
from splatting.demo.objects import Box, Ground, Sphere, Thing, backdrop_texture, ground_texture, marble, panels, stripes
from splatting.demo.tracer import View, look_at
from utils.system_utils import run_cli

_VIEWS, _POINTS = 200, 20_000
_LENGTH, _HOUSES, _HALF_WIDTH = 60.0, 20, 4.0  # of the street in world units, on each side, to a house
_SAMPLES = 2  # rays of a pixel in each direction


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="new folder for the scene")
    parser.add_argument("--size", type=int, nargs=2, default=(320, 200), help="of the photos (default: 320 200)")
    args = parser.parse_args()
    write_scene(args.out, walk(*args.size), street, _POINTS, np.random.default_rng(2), _SAMPLES)


if __name__ == "__main__":
    run_cli(main)
