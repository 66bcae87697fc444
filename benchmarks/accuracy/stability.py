"""Error of the rasterizer on stiff and extreme cases, beside the error of the textbook formulas in float32.

    python -m benchmarks.accuracy.stability [--only TEXT] [--json FILE]

Each case (stability_cases.py) is a scene with ordinary and stiff Gaussians. The reference is the float64 oracle on the
same float32 values.

- The error of a plane is max |difference| / max |reference|, once over the pixels that a stiff Gaussian reaches and
  once over the others. Likewise, the error of a gradient is split into stiff and ordinary Gaussians.
- If the reference of such a part is everywhere below 1e-9 of the tensor's largest value, that value is the divisor.
- A median is over the Gaussians' values of |difference| / |reference| of the gradient; gradients below 1e-6 of the
  largest are left out.
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
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from diff_gaussian_rasterization import rasterize, reference
from torch import Tensor
from tqdm import tqdm

from benchmarks.accuracy.stability_needles import LENGTHS, NeedleError, needle_error
from benchmarks.harness.environment import describe, print_table
from benchmarks.workloads import textbook
from benchmarks.workloads.stability_cases import CASES, PLAIN, Case, Problem
from utils.files.json_files import write_json
from utils.system_utils import run_cli

PLANES = ("color", "inverse_depth", "transmittance")
PARTS = ("ordinary", "stiff")


class Error(NamedTuple):
    """Errors of one part of a tensor; NaN if the part is empty."""

    largest: float
    median: float


class Result(NamedTuple):
    """Errors of a backend on a case, by name and part."""

    finite: bool  # no NaN or Inf in any plane or gradient
    planes: dict[str, dict[str, Error]]
    gradients: dict[str, dict[str, Error]]
    milliseconds: float = math.nan

    def worst(self, kind: str, part: str) -> float:
        """Return the largest error of all `planes` or `gradients` (`kind`); NaN if the part is empty."""
        return max(e[part].largest for e in getattr(self, kind).values())


class Backend(NamedTuple):
    """A renderer with the dtype and device that it runs in."""

    name: str
    render: Callable
    dtype: torch.dtype
    device: str


CPU_FLOAT = Backend("CPU float32", rasterize, torch.float32, "cpu")
CPU_DOUBLE = Backend("CPU float64", rasterize, torch.float64, "cpu")
CUDA_FLOAT = Backend("CUDA float32", rasterize, torch.float32, "cuda")
TEXTBOOK = Backend("textbook float32", textbook.render, torch.float32, "cpu")
CUDA_FACTOR = 3  # a GPU has a fast exponential and reciprocal, for which the design allows more error
ORACLE = Backend("oracle", reference.render, torch.float64, "cpu")


class Judged:
    """A case with the oracle's planes and gradients, which the results of backends are compared with."""

    def __init__(self, case: Case) -> None:
        self.problem = case.problem()
        p = self.problem
        present = ~p.absent
        planes, gradients, self.keep = _run(p, ORACLE, rows=present, cut=case.cut)
        self.planes = planes
        self.gradients = {name: _spread(g, present) for name, g in gradients.items()}
        stiff, alone = p.stiff & present, torch.ones(1)
        if torch.equal(stiff, present):
            alone = planes["transmittance"]
        elif stiff.any():
            alone = _run(p, ORACLE, rows=stiff, cut=case.cut)[0]["transmittance"]
        self.reached = (alone < 1).expand(1, *self.keep.shape)
        self.pixels_left_out = int((~self.keep).sum())

    def result(self, backend: Backend) -> Result:
        """Return the errors of a backend."""
        planes, gradients, _ = _run(self.problem, backend, keep=self.keep)
        return self._compare(planes, gradients)

    def one_rounding(self) -> Result:
        """Return the errors of the oracle when its inputs are off by one float32 rounding."""
        present = ~self.problem.absent
        planes, gradients, _ = _run(_nudged(self.problem), ORACLE, rows=present, keep=self.keep)
        return self._compare(planes, {name: _spread(g, present) for name, g in gradients.items()})

    def _compare(self, planes: dict[str, Tensor], gradients: dict[str, Tensor]) -> Result:
        finite = all(t.isfinite().all() for t in [*planes.values(), *gradients.values()])
        stiff = self.problem.stiff
        by_plane = {
            name: {
                "ordinary": _error(planes[name], wanted, ~self.reached.expand_as(wanted) & self.keep),
                "stiff": _error(planes[name], wanted, self.reached.expand_as(wanted) & self.keep),
            }
            for name, wanted in self.planes.items()
        }
        by_name = {
            name: {part: _row_error(gradients[name], g, stiff == (part == "stiff")) for part in PARTS}
            for name, g in self.gradients.items()
        }
        return Result(bool(finite), by_plane, by_name)

    def milliseconds(self, backend: Backend) -> float:
        """Time forward and backward, least of three. A case has few splats, so this is mostly the call's overhead."""
        times = []
        for _ in range(3):
            start = time.perf_counter()
            _run(self.problem, backend, keep=self.keep)
            times.append(1e3 * (time.perf_counter() - start))
        return min(times)


def beyond(case: Case, backend: Backend, judged: Judged, result: Result) -> list[str]:
    """Return what of our result of a case is not finite, or above the case's bounds; nothing if it is as it should."""
    found = [] if result.finite else [f"{case.name}: NaN or Inf"]
    # If all Gaussians are stiff, the pixels that none reaches are next to pixels that one does.
    ordinary = case.bound.image if judged.problem.stiff.all() else PLAIN.image
    allowed = {("planes", "ordinary"): ordinary, ("planes", "stiff"): case.bound.image}
    allowed |= {("gradients", "ordinary"): PLAIN.gradient, ("gradients", "stiff"): case.bound.gradient}
    for (kind, part), limit in allowed.items():
        limit = case.double if backend == CPU_DOUBLE else (CUDA_FACTOR if backend == CUDA_FLOAT else 1) * limit
        for name, error in getattr(result, kind).items():
            if error[part].largest > limit:  # not if it is NaN: the part is empty
                found.append(f"{case.name}: {name}, {part}, {error[part].largest:.1e} above {limit:.1e}")
    if case.bound.median is not None and backend == CPU_FLOAT:
        median = max(error["stiff"].median for error in result.gradients.values())
        if not median < case.bound.median:
            found.append(f"{case.name}: median of the gradients, {median:.1e} above {case.bound.median:.1e}")
    return found


def _nudged(problem: Problem) -> Problem:
    """Change each parameter by 2^-24 of itself, up or down at random, and round the camera to float32."""
    g = torch.Generator().manual_seed(3)
    parameters = {
        name: t.double() * (1 + 2.0**-24 * (2 * torch.randint(0, 2, t.shape, generator=g) - 1))
        for name, t in problem.parameters.items()
    }
    camera = problem.camera
    rounded = {k: v.float().double() for k, v in camera._asdict().items() if isinstance(v, Tensor)}
    return replace(problem, parameters=parameters, camera=camera._replace(**rounded))


def _run(problem: Problem, backend: Backend, rows: Tensor | None = None, keep: Tensor | None = None, cut: float = 0.0):
    """Return planes and gradients by name, on the CPU, and the pixels that count.

    rows: (N,) bool, the Gaussians to render (default: all). keep: the pixels that count, by default those that the
    oracle finds farther than `cut` from a cut-off.
    """
    device = backend.device
    chosen = {k: t if rows is None else t[rows] for k, t in problem.parameters.items()}
    leaves = {k: t.to(device, backend.dtype, copy=True).requires_grad_() for k, t in chosen.items()}
    camera = problem.camera
    camera = camera._replace(**{k: v.to(device) for k, v in camera._asdict().items() if isinstance(v, Tensor)})
    means2d = torch.zeros_like(leaves["means"], requires_grad=True)
    named = {k: t for k, t in leaves.items() if k not in ("means", "opacities")}
    if backend.render is rasterize:
        named |= {"want_inverse_depth": True, "want_transmittance": True}
    if backend.render is reference.render:
        named |= {"cut": cut}
    out = backend.render(leaves["means"], means2d, leaves["opacities"], camera, raw=problem.raw, **named)
    keep = ~out.near_cut if keep is None else keep
    planes = [getattr(out, name) for name in PLANES]
    generator = torch.Generator().manual_seed(7)
    weights = [torch.randn(plane.shape, generator=generator, dtype=torch.float64) * keep for plane in planes]
    sum((plane * weight.to(plane)).sum() for plane, weight in zip(planes, weights, strict=True)).backward()
    gradients = {name: leaf.grad for name, leaf in leaves.items()} | {"screen mean": means2d.grad}
    return _doubles(dict(zip(PLANES, planes, strict=True))), _doubles(gradients), keep


def _doubles(named: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: t.detach().double().cpu() for name, t in named.items()}


def _spread(rows: Tensor, where: Tensor) -> Tensor:
    out = rows.new_zeros((len(where), *rows.shape[1:]))
    out[where] = rows
    return out


def _largest(difference: Tensor, wanted: Tensor, whole: Tensor) -> float:
    if not difference.numel():
        return math.nan
    scale, all_of_it = float(wanted.abs().max()), float(whole.abs().max())
    if scale < 1e-9 * all_of_it:
        scale = all_of_it
    return float(difference.max()) / (scale or 1.0)


def _difference(got: Tensor, wanted: Tensor) -> Tensor:
    return (got - wanted).abs().nan_to_num(nan=math.inf, posinf=math.inf)


def _error(got: Tensor, wanted: Tensor, where: Tensor) -> Error:
    difference = _difference(got, wanted)[where]
    scale = float(wanted.abs().max()) or 1.0
    median = float(difference.median()) / scale if difference.numel() else math.nan
    return Error(_largest(difference, wanted[where], wanted), median)


def _row_error(got: Tensor, wanted: Tensor, where: Tensor) -> Error:
    if not wanted.numel():
        return Error(math.nan, math.nan)
    difference, part = _difference(got, wanted)[where].flatten(1), wanted[where].flatten(1)
    norms = part.norm(dim=1)
    counted = norms > max(1e-6 * float(norms.max()), 1e-9 * float(wanted.abs().max())) if len(norms) else norms > 0
    of_rows = difference.norm(dim=1)[counted] / norms[counted]
    median = float(of_rows.median()) if len(of_rows) else math.nan
    return Error(_largest(difference, part, wanted), median)


def backends() -> list[Backend]:
    """List the backends that this machine and build offer."""
    cuda = torch.cuda.is_available() and torch._C._dispatch_has_kernel_for_dispatch_key(
        "diff_gaussian_rasterization::rasterize", "CUDA"
    )
    return [CPU_FLOAT, *([CUDA_FLOAT] if cuda else []), CPU_DOUBLE, TEXTBOOK]


def _digits(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.0e}"


def _print_summary(backend: Backend, rounding: dict[str, Result], results: dict[str, dict[str, Result]]) -> None:
    print(f"\n{backend.name}: largest error (one rounding / textbook in float32)\n")
    rows = []
    for case, r in results[backend.name].items():
        cells = []
        for kind in ("planes", "gradients"):
            cells.append(_digits(r.worst(kind, "ordinary")))
            others = [x.worst(kind, "stiff") for x in (rounding[case], results[TEXTBOOK.name][case])]
            cells.append(_digits(r.worst(kind, "stiff")) + " ({} / {})".format(*map(_digits, others)))
        rows.append([case, "yes" if r.finite else "NO", *cells, f"{r.milliseconds:.1f}"])
    print_table(["case", "finite", "image", "image, stiff", "gradients", "gradients, stiff", "ms"], rows)


def _print_gradients(backend: Backend, results: dict[str, dict[str, Result]]) -> None:
    print(f"\n{backend.name}, stiff Gaussians: largest error (median / largest of the textbook in float32)\n")
    names = list(dict.fromkeys(name for r in results[backend.name].values() for name in r.gradients))
    rows = []
    for case, r in results[backend.name].items():
        cells = []
        for name in names:
            ours, theirs = (x.gradients.get(name) for x in (r, results[TEXTBOOK.name][case]))
            values = (ours["stiff"].largest, ours["stiff"].median, theirs["stiff"].largest) if ours else ()
            cells.append("{} ({} / {})".format(*map(_digits, values)) if ours else "")
        rows.append([case, *cells])
    print_table(["case", *(f"d {name}" for name in names)], rows)


def _print_needles(needles: list[NeedleError]) -> None:
    print("\nNeedles on CPU float32: ours (textbook in float32)\n")
    rows = [
        [
            f"{e.low:,.0f} to {e.high:,.0f} px",
            f"{_digits(e.exponent)} ({_digits(e.textbook_exponent)})",
            f"{_digits(e.gradient)} ({_digits(e.textbook_gradient)})",
        ]
        for e in needles
    ]
    print_table(["sigma", "exponent, largest, log2 units", "covariance's gradient, median"], rows)


def _plain(value: float) -> float | str | None:
    return None if math.isnan(value) else value if math.isfinite(value) else "inf"


def _as_json(result: Result) -> dict:
    out: dict = {"finite": result.finite, "milliseconds": _plain(result.milliseconds)}
    for kind in ("planes", "gradients"):
        out[kind] = {
            name: {part: {k: _plain(v) for k, v in e._asdict().items()} for part, e in parts.items()}
            for name, parts in getattr(result, kind).items()
        }
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="also write every error to this file (default: none)")
    parser.add_argument("--only", default="", help="measure the cases whose group or name contains this (default: all)")
    args = parser.parse_args()
    used = backends()
    machine = describe(CUDA_FLOAT.device if CUDA_FLOAT in used else "cpu")
    print(machine)
    wrong: dict[str, list[str]] = {backend.name: [] for backend in used if backend is not TEXTBOOK}
    left_out: dict[str, int] = {}
    rounding: dict[str, Result] = {}
    results: dict[str, dict[str, Result]] = {backend.name: {} for backend in used}
    for case in tqdm(CASES, unit="case", leave=False):
        if args.only not in f"{case.group}: {case.name}":
            continue
        judged = Judged(case)
        left_out[case.name], rounding[case.name] = judged.pixels_left_out, judged.one_rounding()
        for backend in used:
            result = judged.result(backend)
            results[backend.name][case.name] = result._replace(milliseconds=judged.milliseconds(backend))
            if backend is not TEXTBOOK:
                wrong[backend.name] += beyond(case, backend, judged, result)
    needles = [needle_error(*length) for length in LENGTHS] if "needles" in args.only or not args.only else []
    for backend in used:
        if backend is not TEXTBOOK:
            _print_summary(backend, rounding, results)
    for backend in used:
        if backend in (CPU_FLOAT, CUDA_FLOAT):
            _print_gradients(backend, results)
    if needles:
        _print_needles(needles)
    if args.json:
        report = {
            "machine": machine,
            "pixels left out": left_out,
            "one rounding": {case: _as_json(result) for case, result in rounding.items()},
            "needles": [{k: _plain(v) for k, v in e._asdict().items()} for e in needles],
        }
        report |= {name: {case: _as_json(r) for case, r in by_case.items()} for name, by_case in results.items()}
        write_json(args.json, report)
    _print_verdict(len(left_out), wrong)


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
