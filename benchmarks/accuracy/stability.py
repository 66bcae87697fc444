"""Error of the rasterizer on stiff and extreme cases, beside the error of the textbook formulas in float32.

    python -m benchmarks.accuracy.stability [--only TEXT]

Each case (stability_cases.py) is a scene with ordinary and stiff Gaussians. The reference is the float64 oracle on the
same float32 values.

- The error of a plane is max |difference| / max |reference|, once over the pixels that a stiff Gaussian reaches and
  once over the others. Likewise, the error of a gradient is split into stiff and ordinary Gaussians.
- If the reference of such a part is everywhere below 1e-9 of the tensor's largest value, that value is the divisor.
- Rounding alone can decide a pixel within `cut` of a cut-off or with a depth tie. Such pixels are left out of the loss
  and of the comparison.
- "inf" stands for NaN or Inf.
- The last line is the verdict: whether our results are finite and within the bounds of every case. CUDA may have three
  times the CPU's bounds. The exit status is 0 or 1 accordingly.
- "One rounding" is how much the oracle's own result changes when every parameter is off by 2^-24 of itself and the
  camera is rounded to float32. No float32 arithmetic can promise a smaller error.
"""

import argparse
import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.accuracy.runs import CPU_DOUBLE, CUDA_FLOAT, ORACLE, TEXTBOOK, Backend, kernels, run
from benchmarks.harness.measuring import cpu_milliseconds, describe_machine, print_table
from tests.workloads.stability_cases import CASES, PLAIN, Case, Problem
from utils.system_utils import run_cli

PARTS = ("ordinary", "stiff")


class Result(NamedTuple):
    """Errors of a backend on a case, by name and part; NaN if the part is empty."""

    finite: bool  # no NaN or Inf in any plane or gradient
    planes: dict[str, dict[str, float]]
    gradients: dict[str, dict[str, float]]

    def worst(self, kind: str, part: str) -> float:
        """Return the largest error of all `planes` or `gradients` (`kind`); NaN if the part is empty."""
        return max(error[part] for error in getattr(self, kind).values())


CUDA_FACTOR = 3  # a GPU has a fast exponential and reciprocal, for which the design allows more error
ROUNDING = "one rounding"


class Judged:
    """A case with the oracle's planes and gradients, which the results of backends are compared with."""

    def __init__(self, case: Case) -> None:
        """Run the oracle on a case, and find the pixels that its stiff Gaussians reach."""
        self.problem = case.problem()
        p = self.problem
        present = ~p.absent
        planes, gradients, self.keep = run(p, ORACLE, rows=present, cut=case.cut)
        self.planes = planes
        self.gradients = {name: _mask_rows(g, present) for name, g in gradients.items()}
        stiff, alone = p.stiff & present, torch.ones(1)
        if torch.equal(stiff, present):
            alone = planes["transmittance"]
        elif stiff.any():
            alone = run(p, ORACLE, rows=stiff, cut=case.cut)[0]["transmittance"]
        self.reached = (alone < 1).expand(1, *self.keep.shape)

    def result(self, backend: Backend) -> Result:
        """Return the errors of a backend."""
        planes, gradients, _ = run(self.problem, backend, keep=self.keep)
        return self._compare(planes, gradients)

    def one_rounding(self) -> Result:
        """Return the errors of the oracle when its inputs are off by one float32 rounding."""
        present = ~self.problem.absent
        planes, gradients, _ = run(_nudge(self.problem), ORACLE, rows=present, keep=self.keep)
        return self._compare(planes, {name: _mask_rows(g, present) for name, g in gradients.items()})

    def _compare(self, planes: dict[str, Tensor], gradients: dict[str, Tensor]) -> Result:
        """Return the errors of planes and gradients, apart for stiff and ordinary Gaussians or their pixels."""
        finite = all(t.isfinite().all() for t in [*planes.values(), *gradients.values()])
        stiff = self.problem.stiff
        by_plane = {
            name: {
                "ordinary": _relative_error(planes[name], expected, ~self.reached.expand_as(expected) & self.keep),
                "stiff": _relative_error(planes[name], expected, self.reached.expand_as(expected) & self.keep),
            }
            for name, expected in self.planes.items()
        }
        by_name = {
            name: {part: _relative_error(gradients[name], g, stiff == (part == "stiff")) for part in PARTS}
            for name, g in self.gradients.items()
        }
        return Result(bool(finite), by_plane, by_name)

    def milliseconds(self, backend: Backend) -> float:
        """Time forward and backward. A case has few splats, so this is mostly the call's overhead."""
        return cpu_milliseconds(lambda: run(self.problem, backend, keep=self.keep), repeats=3)


def find_excess(case: Case, backend: Backend, judged: Judged, result: Result) -> list[str]:
    """Return the parts of our result of a case that are not finite or above the case's bounds; empty if none are."""
    found = [] if result.finite else [f"{case.name}: NaN or Inf"]
    # If all Gaussians are stiff, the pixels that none reaches are next to pixels that one does.
    ordinary = case.bound.image if judged.problem.stiff.all() else PLAIN.image
    allowed = {("planes", "ordinary"): ordinary, ("planes", "stiff"): case.bound.image}
    allowed |= {("gradients", "ordinary"): PLAIN.gradient, ("gradients", "stiff"): case.bound.gradient}
    for (kind, part), limit in allowed.items():
        limit = case.double if backend == CPU_DOUBLE else (CUDA_FACTOR if backend == CUDA_FLOAT else 1) * limit
        for name, error in getattr(result, kind).items():
            if error[part] > limit:  # not if it is NaN: the part is empty
                found.append(f"{case.name}: {name}, {part}, {error[part]:.1e} above {limit:.1e}")
    return found


def _nudge(problem: Problem) -> Problem:
    """Change each parameter by 2^-24 of itself, up or down at random, and round the camera to float32."""
    g = torch.Generator().manual_seed(3)
    parameters = {
        name: t.double() * (1 + 2.0**-24 * (2 * torch.randint(0, 2, t.shape, generator=g) - 1))
        for name, t in problem.parameters.items()
    }
    camera = problem.camera
    rounded = {k: v.float().double() for k, v in camera._asdict().items() if isinstance(v, Tensor)}
    return replace(problem, parameters=parameters, camera=camera._replace(**rounded))


def _mask_rows(rows: Tensor, where: Tensor) -> Tensor:
    out = rows.new_zeros((len(where), *rows.shape[1:]))
    out[where] = rows
    return out


def _relative_error(got: Tensor, expected: Tensor, where: Tensor) -> float:
    """The largest |difference| of the part `where`, over its largest |expected|; NaN if the part is empty."""
    difference = (got - expected).abs().nan_to_num(nan=math.inf, posinf=math.inf)[where]
    if not difference.numel():
        return math.nan
    scale, whole = float(expected[where].abs().max()), float(expected.abs().max())
    return float(difference.max()) / ((whole if scale < 1e-9 * whole else scale) or 1.0)


def _format_digits(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.0e}"


def print_report(results: dict[str, dict[str, Result]]) -> None:
    """Print a table for each of our backends. results: by backend, "one rounding" among them, and case."""
    for backend in (name for name in results if name not in (TEXTBOOK.name, ROUNDING)):
        print(f"\n{backend}: largest error (one rounding / textbook in float32)\n")
        rows = []
        for case, result in results[backend].items():
            cells = []
            for kind in ("planes", "gradients"):
                cells.append(_format_digits(result.worst(kind, "ordinary")))
                others = [results[name][case].worst(kind, "stiff") for name in (ROUNDING, TEXTBOOK.name)]
                cells.append(
                    _format_digits(result.worst(kind, "stiff")) + " ({} / {})".format(*map(_format_digits, others))
                )
            rows.append([case, "yes" if result.finite else "NO", *cells])
        print_table(["case", "finite", "image", "image, stiff", "gradients", "gradients, stiff"], rows)


def main() -> None:
    """Print the errors of all backends on all cases; end with an error if a result is worse than allowed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="measure the cases whose group or name contains this (default: all)")
    args = parser.parse_args()
    used = [*kernels(), TEXTBOOK]
    print(describe_machine(CUDA_FLOAT.device if CUDA_FLOAT in used else "cpu"))
    cases = [case for case in CASES if args.only in f"{case.group}: {case.name}"]
    wrong: dict[str, list[str]] = {backend.name: [] for backend in used if backend is not TEXTBOOK}
    results: dict[str, dict[str, Result]] = {name: {} for name in (*(backend.name for backend in used), ROUNDING)}
    for case in tqdm(cases, unit="case", leave=False):
        judged = Judged(case)
        results[ROUNDING][case.name] = judged.one_rounding()
        for backend in used:
            result = results[backend.name][case.name] = judged.result(backend)
            if backend is not TEXTBOOK:
                wrong[backend.name] += find_excess(case, backend, judged, result)
    print_report(results)
    _print_verdict(len(cases), wrong)


def _print_verdict(cases: int, wrong: dict[str, list[str]]) -> None:
    """Print whether all cases are within their bounds; end with status 1 if not."""
    failed = [f"{name}: {line}" for name, lines in wrong.items() for line in lines]
    print("\n".join(["", *failed]))
    names = ", ".join(wrong)
    if failed or not cases:
        print(f"Verdict: NOT STABLE. Of {cases} cases on {names}, {len(failed)} results are beyond their bounds.")
        raise SystemExit(1)
    print(f"Verdict: stable. All {cases} cases are finite and within their bounds on {names}.")


if __name__ == "__main__":
    run_cli(main)
