"""Cost of each feature when it is off: time and bytes, compared with code that does not have the feature.

    python -m benchmarks.costs.measure                                  # on the GPU if there is one
    python -m benchmarks.costs.measure --write docs/results/costs.md

The calls of a row take turns. A difference is the median over rounds of the differences within a round, with its 95 %
interval; it is within noise if that interval contains 0. Bytes are those that one call allocates, plus, in the rows
that say so, those that stay allocated. --write replaces the tables between the device's marks in that page.
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import torch
from diff_gaussian_rasterization import ops

from benchmarks.costs.allocations import allocated_bytes
from benchmarks.costs.paired import Interval, difference, interleaved
from benchmarks.costs.rows import ROWS, Row, Workload
from benchmarks.harness.environment import describe, table
from benchmarks.harness.page import check_marks, write_tables
from utils.system_utils import UserError, compute_device, run_cli

ROOT = Path(__file__).resolve().parents[2]

#              splats  width height median pixel sigma
WORKLOADS = {"cpu": (50_000, 400, 400, 2.4), "cuda": (1_000_000, 1600, 1060, 1.7)}
HEADER = ["feature, off", "compared with", "ms", "ms more than that [95 %]", "", "bytes more"]
HEADER += ["switched on: ms more", "bytes more"]


def measure(row: Row, rounds: int, device: torch.device) -> list[str]:
    """Measure a row of the first table and return its cells."""
    calls: dict[str, Callable[[], object]] = {"off": row.off}
    calls |= {name: call for name, call in (("base", row.base), ("on", row.on)) if call is not None}
    times = interleaved(calls, rounds, device)
    taken = {name: allocated_bytes(call, device) for name, call in calls.items()}
    if row.base_bytes is not None:
        taken["base"] = row.base_bytes
    cells = [row.feature, row.compared, f"{statistics.median(times['off']):.3f}", "", "", "", "", ""]
    if row.base is not None:
        cost = difference(times["off"], times["base"])
        cells[3] = _milliseconds(cost)
        cells[4] = "within noise" if cost.within_noise else "slower" if cost.low > 0 else "faster"
    if "base" in taken:
        cells[5] = f"{taken['off'] - taken['base'] + row.kept[1] - row.kept[0]:,}"
    if row.on is not None:
        cells[6] = _milliseconds(difference(times["on"], times["off"]))
        cells[7] = f"{taken['on'] - taken['off']:,}"
    return cells


def _milliseconds(cost: Interval) -> str:
    return f"{cost.median:+.3f} [{cost.low:+.3f}, {cost.high:+.3f}]"


def absent() -> list[list[str]]:
    """Return the rows of the second table: things that do not exist at all when a feature is off."""
    with tempfile.TemporaryDirectory() as folder:
        seen = json.loads(_python("-m", "benchmarks.costs.probe", folder))
    curves = [name for name in seen["files"] if "error_vs_time" in name]
    tests = [name for name in seen["decoded"] if name.startswith("test/")]
    extra = sum(seen["picture_bytes"]) - seen["values"] * len(seen["picture_bytes"])

    def loaded(module: str) -> str:
        return f"{module} loaded: {'yes' if module in seen['modules'] else 'no'}"

    doubles, library = _double_bytes()
    no_test_photos = "test photos (--test_iterations -1 --no_curve)"
    return [
        ["pycolmap at import (Blender scene)", loaded("pycolmap"), _import_cost("pycolmap")],
        ["curve recording (--no_curve)", f"files: {len(curves)}; {loaded('matplotlib')}", _import_cost("matplotlib")],
        [no_test_photos, f"decoded: {len(tests)} of 2", "3 bytes a pixel"],
        ["viewer", f"sockets bound: {len(seen['binds'])}", ""],
        ["TensorBoard", f"{loaded('tensorboard')} (yes wherever it is installed)", ""],
        ["LPIPS, outside metrics.py", loaded("lpips"), ""],
        ["alpha of opaque photos, pixels beyond training size", f"bytes kept: {extra}", ""],
        ["double kernels", "entered with float64 tensors only", f"{doubles} of {library:,} bytes on disk"],
    ]


def _import_cost(module: str) -> str:
    """Measure time and memory of an import in a new process that has imported Pillow and NumPy."""
    code = f"""
import re, time
import numpy
from PIL import Image
def resident():
    return int(re.search(r"VmRSS:\\s+(\\d+)", open("/proc/self/status").read())[1]) / 1024
before, start = resident(), time.perf_counter()
import {module}
print(f"{{1e3 * (time.perf_counter() - start):.0f}} ms, {{resident() - before:.0f}} MiB")
"""
    return _python("-c", code).strip()


def _python(*arguments: str) -> str:
    done = subprocess.run([sys.executable, *arguments], cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        raise UserError(f"{arguments[0]} ended with status {done.returncode}:\n{done.stderr[-2000:]}")
    return done.stdout


def _double_bytes() -> tuple[str, int]:
    """Return the bytes of the rasterizer's functions for double, from the symbol table, and of the whole library."""
    library = Path(ops.__file__).with_name("_backend.so")
    try:
        done = subprocess.run(["nm", "-S", "-C", str(library)], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "not known (no nm)", library.stat().st_size
    sizes = {}
    for line in done.stdout.splitlines():
        address, size, *rest = line.split(maxsplit=3)
        if len(rest) == 2 and rest[0] in "tTwW" and "<double" in rest[1]:
            sizes[address] = int(size, 16)
    return f"{sum(sizes.values()):,}", library.stat().st_size


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--rounds", type=int, default=41, help="how often each call is timed (default: 41)")
    add("--splats", type=int, help="number of Gaussians in the model (default: 50,000; on a GPU 1,000,000)")
    add("--write", type=Path, help="page whose tables to replace (default: only print)")
    args = parser.parse_args()
    device = compute_device()
    if args.write:
        check_marks(args.write, device.type)
    splats, width, height, sigma = WORKLOADS[device.type]
    splats = args.splats or splats
    work = Workload(splats, width, height, sigma, device)
    what = f"{splats:,} splats, {width}x{height}, median sigma {sigma} px, {args.rounds} rounds."
    lines = ["", describe(device) + ".", what, ""]
    lines += table(HEADER, [measure(make(work), args.rounds, device) for make in ROWS])
    lines += ["", *table(["not there when off", "seen", "what that saves"], absent()), ""]
    print("\n".join(lines))
    if args.write:
        write_tables(args.write, device.type, lines)


if __name__ == "__main__":
    run_cli(main)
