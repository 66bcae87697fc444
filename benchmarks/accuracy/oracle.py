"""Error of every output and every gradient of the rasterizer against the float64 oracle, and against run time.

    python -m benchmarks.accuracy.oracle                                    # print the errors
    python -m benchmarks.accuracy.oracle --figure docs/accuracy.png         # and draw error against run time
    python -m benchmarks.accuracy.oracle --json accuracy.json               # and write the numbers; a machine with
    python -m benchmarks.accuracy.figure accuracy.json docs/accuracy.png    # matplotlib can draw them

The error of a tensor is max |difference| / max |reference|; the median of |difference| / max |reference| stands beside
it. Rounding alone can decide a pixel that is within 1e-4 of a cut-off (alpha 1/255, transmittance 1e-4) or that has a
depth tie. Such pixels are left out of the loss and of the comparison; a row of the table counts them. The oracle gets
the float32 value of every parameter, so the kernels of CPU and GPU all compute the same function.

--figure and --json also time each kernel. They also measure a second build of the rasterizer, which has the standard
library's exponential instead of the fast one; exact_exponential.py makes it under build/ on first use. Errors come from
scenes small enough for the oracle. The time beside an error is forward and backward of one image of a larger scene of
the same family (TIMED_SIZES in kernel_runs.py).
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.accuracy import exact_exponential
from benchmarks.accuracy.figure import draw, require_matplotlib
from benchmarks.accuracy.kernel_runs import (
    CASES,
    CPU_DOUBLE,
    CPU_FLOAT,
    CUDA_FLOAT,
    TIMED_SIZES,
    Case,
    Kernel,
    Run,
    kernels,
    run_all,
    run_oracle,
)
from benchmarks.harness.environment import describe, print_table
from utils.files.json_files import write_json
from utils.system_utils import run_cli

ROOT = Path(__file__).resolve().parents[2]
Runs = dict[tuple[Case, Kernel], Run]

# Wanted bound on the error of CUDA float over the error of CPU float, both measured against CPU double.
MOST = 3.0
# Errors below this are a few units in the last place, where a single rounding changes the ratio.
SMALL = 1e-6


def error(got: Tensor, wanted: Tensor) -> tuple[float, float]:
    """Return the largest and the median |difference|, both divided by the largest |wanted|."""
    difference, scale = (got.double() - wanted.double()).abs(), wanted.double().abs().max().clamp_min(1e-300)
    return float(difference.max() / scale), float(difference.median() / scale)


def run_exact(masks: dict[Case, Tensor]) -> Runs:
    """Call `run_all` with times in a new process, with the build that has the exact exponential."""
    package = exact_exponential.build()
    path = os.pathsep.join([str(package), str(ROOT), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    with tempfile.TemporaryDirectory() as folder:
        given, taken = Path(folder) / "masks.pt", Path(folder) / "runs.pt"
        torch.save({tuple(case): mask for case, mask in masks.items()}, given)
        command = [sys.executable, "-m", "benchmarks.accuracy.kernel_runs", str(given), str(taken), "--times"]
        subprocess.run(command, cwd=ROOT, env=os.environ | {"PYTHONPATH": path}, check=True)
        result = torch.load(taken)
    assert Path(result["package"]).is_relative_to(package), f"{result['package']} was measured, not {package}"
    return {(Case(*key[:2]), Kernel(*key[2:])): Run(*run) for key, run in result["runs"].items()}


def measure(times: bool) -> tuple[list[dict], dict[Case, Runs]]:
    """Return a record per run, as --json writes them, and the runs of the installed build."""
    oracle = {case: run_oracle(case) for case in tqdm(CASES, desc="Oracle", unit="scene", leave=False)}
    masks = {case: keep for case, (_, keep) in oracle.items()}
    fast = run_all(masks, times)
    builds = {"fast": fast} | ({"exact": run_exact(masks)} if times else {})
    records = []
    for exponential, runs in builds.items():
        for (case, kernel), run in runs.items():
            wanted, keep = oracle[case]
            records.append(
                {
                    "scene": case.kind,
                    "antialiasing": case.antialiasing,
                    "kernel": str(kernel),
                    "exponential": exponential,
                    "errors": {name: error(run.tensors[name], value) for name, value in wanted.items()},
                    "pixels left out": int((~keep).sum()),
                    "milliseconds": run.milliseconds,
                }
            )
    return records, fast


def print_errors(records: list[dict]) -> None:
    """Print a table of largest (median) errors for each exponential and antialiasing setting."""
    for exponential in dict.fromkeys(r["exponential"] for r in records):
        for antialiasing in (False, True):
            chosen = [r for r in records if (r["exponential"], r["antialiasing"]) == (exponential, antialiasing)]
            chosen.sort(key=lambda r: list(TIMED_SIZES).index(r["scene"]))
            print(
                f"\nLargest (median) error, {exponential} exponential, antialiasing {'on' if antialiasing else 'off'}"
            )
            rows = [
                [name, *("{:.1e} ({:.0e})".format(*r["errors"][name]) for r in chosen)] for name in chosen[0]["errors"]
            ]
            rows.append(["pixels left out", *(str(r["pixels left out"]) for r in chosen)])
            if chosen[0]["milliseconds"] is not None:
                rows.append(["forward + backward, ms", *(f"{r['milliseconds']:.1f}" for r in chosen)])
            print_table(["", *(f"{r['scene']}, {r['kernel']}" for r in chosen)], rows)


def print_ratios(runs: Runs) -> None:
    """Print the largest errors of CUDA float and CPU float, both against CPU double, and their ratio."""
    rows, ratios = [], {}
    for name in next(iter(runs.values())).tensors:
        row = [name]
        for case in CASES:
            wanted = runs[case, CPU_DOUBLE].tensors[name]
            cuda, cpu = (error(runs[case, kernel].tensors[name], wanted)[0] for kernel in (CUDA_FLOAT, CPU_FLOAT))
            ratios[name, case] = (cuda / max(cpu, 1e-300), max(cuda, cpu))
            row.append(f"{cuda:.1e} / {cpu:.1e} = {ratios[name, case][0]:.2f}")
        rows.append(row)
    print("\nLargest error against CPU double: CUDA float / CPU float = ratio")
    print_table(["", *(f"{case.kind}{', antialiased' if case.antialiasing else ''}" for case in CASES)], rows)
    notable = [ratio for ratio, larger in ratios.values() if larger > SMALL]
    print(f"Largest ratio: {max(ratio for ratio, _ in ratios.values()):.2f}", end="; ")
    print(f"where either error exceeds {SMALL:.0e}: {max(notable, default=0):.2f} (at most {MOST:g} wanted)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--figure", type=Path, help="also time the kernels, and draw error against time to this file")
    parser.add_argument("--json", type=Path, help="also time the kernels, and write every measurement to this file")
    args = parser.parse_args()
    if args.figure:
        require_matplotlib()
    machines = list(dict.fromkeys(describe(kernel.device) for kernel in kernels()))
    print("\n".join(machines))
    records, runs = measure(times=bool(args.figure or args.json))
    print_errors(records)
    if CUDA_FLOAT in kernels():
        print_ratios(runs)
    measured = {"machines": machines, "records": records, "timed sizes": TIMED_SIZES}
    if args.json:
        write_json(args.json, measured)
    if args.figure:
        draw(measured, args.figure)


if __name__ == "__main__":
    run_cli(main)
