"""Error of every output and every gradient of the rasterizer against the float64 oracle, and run time.

    python -m benchmarks.accuracy.oracle             # print the errors
    python -m benchmarks.accuracy.oracle --times     # and the kernels' run times

The error of a tensor is max |difference| / max |reference|; the median of |difference| / max |reference| stands beside
it. Rounding alone can decide a pixel that is within 1e-4 of a cut-off (alpha 1/255, transmittance 1e-4) or that has a
depth tie. Such pixels are left out of the loss and of the comparison; a row of the table counts them. The oracle gets
the float32 value of every parameter, so the kernels of CPU and GPU all compute the same function.

--times times forward and backward of one image of a larger scene of the same family, at a size where work dominates on
a GPU as well.
"""

import argparse
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.accuracy.runs import CPU_DOUBLE, CPU_FLOAT, CUDA_FLOAT, ORACLE, Backend, kernels, run
from benchmarks.harness.calls import Calls
from benchmarks.harness.measuring import cpu_milliseconds, describe_machine, gpu_milliseconds, print_table
from tests.workloads.splat_scenes import KINDS
from tests.workloads.stability_cases import Problem, all_stiff
from utils.system_utils import run_cli

TIMED_SIZES = {"ordinary": (200_000, 1200, 900), "needles": (20_000, 1200, 900), "huge and tiny": (3_000, 1200, 900)}
CPU_REPEATS = 5
# Allowed bound on the error of CUDA float over the error of CPU float, both measured against CPU double.
MOST = 3.0
# Errors below this are a few units in the last place, where a single rounding changes the ratio.
SMALL = 1e-6


class Case(NamedTuple):
    """A scene and a setting to render it with."""

    kind: str  # a key of KINDS
    antialiasing: bool


CASES = [Case(kind, antialiasing) for antialiasing in (False, True) for kind in KINDS]
CUT = 1e-4  # pixels this near to a cut-off (relative) do not count
Runs = dict[tuple[Case, Backend], dict[str, Tensor]]  # planes, zero at the pixels left out, and gradients


def problem(case: Case) -> Problem:
    """The case's scene, rounded to float32, and its camera in float64, which each kernel rounds."""
    scene = KINDS[case.kind]()
    parameters = {name: values.float() for name, values in scene.parameters.items()}
    return all_stiff(parameters, scene.settings(torch.float64, antialiasing=case.antialiasing))


def tensors(planes: dict[str, Tensor], gradients: dict[str, Tensor], keep: Tensor) -> dict[str, Tensor]:
    """All tensors of a run by name; planes are zero at the pixels left out."""
    return {k: t * keep for k, t in planes.items()} | {f"d {k}": t for k, t in gradients.items()}


def milliseconds(case: Case, kernel: Backend) -> float:
    """Time forward and backward of one image; on a GPU by events, which include the host's part of the call."""
    scene = KINDS[case.kind](*TIMED_SIZES[case.kind]).to(kernel.device)
    call = Calls(scene, kernel.dtype, case.antialiasing).with_backward
    return gpu_milliseconds(call) if kernel.device == "cuda" else cpu_milliseconds(call, CPU_REPEATS)


def error(got: Tensor, expected: Tensor) -> tuple[float, float]:
    """Return the largest and the median |difference|, both divided by the largest |expected|."""
    difference, scale = (got - expected).abs(), expected.abs().max().clamp_min(1e-300)
    return float(difference.max() / scale), float(difference.median() / scale)


def measure(times: bool) -> tuple[list[dict], Runs]:
    """Return a record of each run, and the tensors."""
    records, runs = [], {}
    for case in tqdm(CASES, unit="scene", leave=False):
        truth = run(problem(case), ORACLE, cut=CUT)
        expected, keep = tensors(*truth), truth[2]
        for kernel in kernels():
            found = runs[case, kernel] = tensors(*run(problem(case), kernel, keep=keep))
            records.append(
                {
                    "scene": case.kind,
                    "antialiasing": case.antialiasing,
                    "kernel": kernel.name,
                    "errors": {name: error(found[name], value) for name, value in expected.items()},
                    "pixels left out": int((~keep).sum()),
                    "milliseconds": milliseconds(case, kernel) if times else None,
                }
            )
    return records, runs


def print_errors(records: list[dict]) -> None:
    """Print a table of largest (median) errors for each antialiasing setting."""
    for antialiasing in (False, True):
        chosen = [record for record in records if record["antialiasing"] == antialiasing]
        print(f"\nLargest (median) error, antialiasing {'on' if antialiasing else 'off'}")
        rows = [
            [name, *("{:.1e} ({:.0e})".format(*record["errors"][name]) for record in chosen)]
            for name in chosen[0]["errors"]
        ]
        rows.append(["pixels left out", *(str(record["pixels left out"]) for record in chosen)])
        if chosen[0]["milliseconds"] is not None:
            rows.append(["forward + backward, ms", *(f"{record['milliseconds']:.1f}" for record in chosen)])
        print_table(["", *(f"{record['scene']}, {record['kernel']}" for record in chosen)], rows)


def print_ratios(runs: Runs) -> None:
    """Print the largest errors of CUDA float and CPU float, both against CPU double, and their ratio."""
    rows, ratios = [], []
    for name in next(iter(runs.values())):
        row = [name]
        for case in CASES:
            expected = runs[case, CPU_DOUBLE][name]
            cuda, cpu = (error(runs[case, kernel][name], expected)[0] for kernel in (CUDA_FLOAT, CPU_FLOAT))
            ratios.append((cuda / max(cpu, 1e-300), max(cuda, cpu)))
            row.append(f"{cuda:.1e} / {cpu:.1e} = {ratios[-1][0]:.2f}")
        rows.append(row)
    print("\nLargest error against CPU double: CUDA float / CPU float = ratio")
    print_table(["", *(f"{case.kind}{', antialiased' if case.antialiasing else ''}" for case in CASES)], rows)
    notable = [ratio for ratio, larger in ratios if larger > SMALL]
    print(f"Largest ratio: {max(ratio for ratio, _ in ratios):.2f}", end="; ")
    print(f"where either error exceeds {SMALL:.0e}: {max(notable, default=0):.2f} (at most {MOST:g} allowed)")


def main() -> None:
    """Print the errors of all kernels against the oracle and, with a GPU, their ratio to those of the CPU."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--times", action="store_true", help="also time the kernels")
    args = parser.parse_args()
    print("\n".join(dict.fromkeys(describe_machine(kernel.device) for kernel in kernels())))
    records, runs = measure(args.times)
    print_errors(records)
    if CUDA_FLOAT in kernels():
        print_ratios(runs)


if __name__ == "__main__":
    run_cli(main)
