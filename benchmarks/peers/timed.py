"""The frame of another program's training: the clock stands while a PLY is written.

Writes OUT/point_cloud/iteration_N, OUT/cfg_args and OUT/seconds.csv, which `python -m benchmarks.peers.curve -m OUT`
reads.
"""

import random
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Protocol

import torch

from arguments import ModelParams, write_cfg_args
from benchmarks.harness.measuring import describe_machine
from benchmarks.peers.curve import SECONDS
from scene.gaussian_model import GaussianModel
from scene.scene import Scene
from splatting.records.error_curve import Row, write_peer
from utils.system_utils import UserError, compute_device, mkdir_p, saved_ply

DEGREE = 3  # of SH
# Not at multiples of 100, where density control has just changed the model, which scores low for some iterations.
SAVES = (250, 550, 1050, 2050, 4050, 7050, 10_050, 15_050, 20_050, 30_000)


class Training(Protocol):
    """Another program's training; its length is the number of Gaussians."""

    def __len__(self) -> int: ...

    def step(self, step: int) -> None:
        """An iteration; the first one is 0."""

    def save(self, path: Path) -> None:
        """Write a PLY in the world of the dataset."""


def shuffle_forever(views: Sequence, seed: int) -> Iterator:
    """All views in a random order, again and again."""
    rng = random.Random(seed)
    while True:
        yield from rng.sample(views, len(views))


def _read_clock() -> float:
    if compute_device().type == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter()


def run(training: Training, model: Path, saves: Sequence[int]) -> list[Row]:
    """Train to the last of `saves`, write a PLY at each, and return rows of SECONDS."""
    rows, seconds, done = [], 0.0, 0
    for stop in saves:
        begin = _read_clock()
        for step in range(done, stop):
            training.step(step)
        seconds, done = seconds + _read_clock() - begin, stop
        mkdir_p(saved_ply(model, stop).parent)
        training.save(saved_ply(model, stop))
        peak = torch.cuda.max_memory_allocated() / 2**20 if compute_device().type == "cuda" else None
        rows.append({"iteration": stop, "seconds": seconds, "gaussians": len(training), "peak_memory_mib": peak})
        print(rows[-1], flush=True)
        write_peer(model / SECONDS, rows)
    return rows


def train(parser: ArgumentParser, start: Callable[[Scene, ModelParams, Namespace], Training]) -> None:
    """Parse the command line, start a training on its scene, and run it."""
    model_params, add = ModelParams(parser), parser.add_argument
    add("--iterations", type=int, default=SAVES[-1], help=f"default: {SAVES[-1]}")
    add("--save_iterations", type=int, nargs="+", default=SAVES, help=f"default: {' '.join(map(str, SAVES))}")
    add("--seed", type=int, default=0, help="default: 0")
    args = parser.parse_args()
    options, model = model_params.extract(args), Path(args.model_path)
    if not args.model_path or model.exists():
        raise UserError(f"-m must name a new folder, got {args.model_path or 'none'}")
    torch.manual_seed(args.seed)
    training = start(Scene(options, GaussianModel(DEGREE), shuffle=False, start=False), options, args)
    print(describe_machine(compute_device()))
    mkdir_p(model)
    write_cfg_args(model, options)
    run(training, model, sorted({step for step in args.save_iterations if step < args.iterations} | {args.iterations}))
