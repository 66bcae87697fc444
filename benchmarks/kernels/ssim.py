"""Microseconds of L1 + D-SSIM on a GPU: forward, backward and both, of one build or of two by turns.

    python -m benchmarks.kernels.ssim
    python -m benchmarks.kernels.ssim --builds OLD NEW    # folders that hold an installed fused_ssim each

Twenty calls are captured in a CUDA graph and replayed, so that the host and the gaps between launches of one call at a
time do not count. Figures are medians over the replays, then over the rounds.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import torch

from benchmarks.harness.environment import describe, print_table
from utils.system_utils import UserError, run_cli

SIZES = [(400, 400), (538, 960), (1600, 1060)]  # height, width; three planes
CALLS, REPLAYS, WARM_UPS = 20, 50, 5
LAMBDA = 0.2


def microseconds(run: Callable[[], object]) -> float:
    """Return the median time of a call within a replayed CUDA graph."""
    run()  # a capture needs every kernel loaded
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        for _ in range(CALLS):
            run()
    times = []
    begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    for _ in range(WARM_UPS + REPLAYS):
        begin.record()
        graph.replay()
        end.record()
        end.synchronize()
        times.append(1e3 * begin.elapsed_time(end) / CALLS)
    return statistics.median(times[WARM_UPS:])


def measure(height: int, width: int) -> dict[str, float]:
    """Microseconds of the loss of a render and a photo of bytes, as training calls it."""
    from fused_ssim.backend import OPERATORS  # the build that this process got

    random = torch.Generator(device="cuda").manual_seed(1)
    image = torch.rand((3, height, width), generator=random, device="cuda")
    photo = torch.randint(0, 256, image.shape, generator=random, device="cuda", dtype=torch.uint8)
    one = torch.ones((), device="cuda")
    kept = OPERATORS.photometric(image, photo, LAMBDA, True)[2]

    def forward() -> torch.Tensor:
        return OPERATORS.photometric(image, photo, LAMBDA, True)[2]

    def backward(kept: torch.Tensor = kept) -> torch.Tensor:
        return OPERATORS.photometric_vjp(image, photo, kept, LAMBDA, one)

    return {
        "forward": microseconds(forward),
        "backward": microseconds(backward),
        "both": microseconds(lambda: backward(forward())),
        "loss alone": microseconds(lambda: OPERATORS.photometric(image, photo, LAMBDA, False)),
    }


def measure_in_child(build: str) -> list[dict[str, float]]:
    """Measure every size with the fused_ssim of a folder."""
    path = os.pathsep.join(filter(None, [build, os.environ.get("PYTHONPATH")]))
    command = [sys.executable, "-m", "benchmarks.kernels.ssim", "--json"]
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        raise UserError(f"the measurement with {build} failed: see above")
    return json.loads(done.stdout)


def print_results(builds: list[str], rounds: list[list[list[dict[str, float]]]]) -> None:
    """Print medians over the rounds, and the ratio of the last build to the first."""
    rows = []
    for i, (height, width) in enumerate(SIZES):
        for what in rounds[0][0][i]:
            values = [statistics.median(results[b][i][what] for results in rounds) for b in range(len(builds))]
            ratio = [f"{values[-1] / values[0]:.3f}"] if len(builds) > 1 else []
            rows.append([f"{height}x{width}", what, *(f"{value:.1f}" for value in values), *ratio])
    ratio = ["last / first"] if len(builds) > 1 else []
    print_table(["size", "us", *builds, *ratio], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--builds", nargs="+", metavar="FOLDER", help="folders with a fused_ssim (default: the one installed)")
    add("--rounds", type=int, default=5, help="turns of each build (default: 5)")
    add("--json", action="store_true", help="print the figures of the installed build alone, as JSON")
    args = parser.parse_args()
    if not torch.cuda.is_available():
        raise UserError("this measures a GPU, and torch finds none")
    if args.json:
        print(json.dumps([measure(*size) for size in SIZES]))
        return
    for build in args.builds or []:
        if not (Path(build) / "fused_ssim").is_dir():
            raise UserError(f"{build} holds no fused_ssim: install one there with pip install --target")
    print(describe("cuda"))
    if args.builds:
        rounds = [[measure_in_child(build) for build in args.builds] for _ in range(args.rounds)]
        print_results(args.builds, rounds)
    else:
        print_results(["installed"], [[[measure(*size) for size in SIZES]] for _ in range(args.rounds)])


if __name__ == "__main__":
    run_cli(main)
