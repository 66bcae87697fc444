"""benchmarks/accuracy: the error, the exact exponential, the figure, and runs of the kernels on small scenes."""

import re
import shutil
import subprocess
from functools import partial

import pytest
import torch
from PIL import Image

from benchmarks.accuracy import exact_exponential, figure, kernel_runs
from benchmarks.accuracy.kernel_runs import CPU_DOUBLE, CPU_FLOAT, CUDA_FLOAT
from benchmarks.accuracy.oracle import error, measure, print_errors, print_ratios

COMMON = exact_exponential.ROOT / "submodules" / "common" / "include"
SHIPPED = exact_exponential.ROOT / "submodules" / exact_exponential.EXTENSION / "csrc" / "math" / "exp2.h"

# Prints the largest relative error of both headers' exp2_lanes, float then double.
EXP2_PROGRAM = f"""
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdint>
#define GS_ISA shipped
#include "{SHIPPED}"
#undef GS_ISA
#define GS_ISA exact
#include "{exact_exponential.HEADER}"

template <class T, class V, class I, V (*exp2_lanes)(V, T)>
void print_error() {{
  long double worst = 0;
  for (double t = -119.9; t < 119; t += 0.0137) {{
    const T exponent = T(t);
    const long double wanted = std::exp2((long double)exponent);
    worst = std::max(worst, std::abs(exp2_lanes(V{{}} + exponent, T())[1] / wanted - 1));
  }}
  std::printf("%Lg\\n", worst);
}}

typedef float Floats __attribute__((vector_size(16)));
typedef int32_t Ints __attribute__((vector_size(16)));
typedef double Doubles __attribute__((vector_size(16)));
typedef int64_t Longs __attribute__((vector_size(16)));

int main() {{
  print_error<float, Floats, Ints, gs::shipped::exp2_lanes<Floats, Ints>>();
  print_error<double, Doubles, Longs, gs::shipped::exp2_lanes<Doubles, Longs>>();
  print_error<float, Floats, Ints, gs::exact::exp2_lanes<Floats, Ints>>();
  print_error<double, Doubles, Longs, gs::exact::exp2_lanes<Doubles, Longs>>();
}}
"""


@pytest.fixture
def small_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_runs, "KINDS", {k: partial(v, 40, 30, 20) for k, v in kernel_runs.KINDS.items()})


def test_error_is_of_the_largest_reference_value():
    assert error(torch.tensor([1.0, 2.5, -4.0]), torch.tensor([1.0, 2.0, -5.0])) == (0.2, 0.1)


def test_runs_agree_with_the_oracle_and_are_reported(small_scenes, capsys):
    records, runs = measure(times=False)
    assert len(records) == 6 * len(kernel_runs.kernels())
    for record in records:
        bound = 1e-6 if record["kernel"] == "CPU float64" else 1e-3  # far from both, so that a mix-up shows
        assert {name for name, (largest, median) in record["errors"].items() if not median <= largest < bound} == set()
        assert record["milliseconds"] is None and record["exponential"] == "fast"
    assert max(record["errors"]["image"][0] for record in records if "float32" in record["kernel"]) > 1e-8
    print_errors(records)
    said = capsys.readouterr().out
    assert said.count("| d screen mean ") == 2 and "ordinary, CPU float64" in said
    # Without a GPU the double kernel replaces it, so that every ratio is zero.
    for case in kernel_runs.CASES:
        runs[case, CUDA_FLOAT] = runs[case, CPU_DOUBLE]
    print_ratios(runs)
    said = capsys.readouterr().out
    assert said.endswith("Largest ratio: 0.00; where either error exceeds 1e-06: 0.00 (at most 3 wanted)\n")
    for case in kernel_runs.CASES:
        runs[case, CUDA_FLOAT] = runs[case, CPU_FLOAT]
    print_ratios(runs)
    assert "where either error exceeds 1e-06: 1.00 (at most 3" in capsys.readouterr().out


@pytest.mark.skipif(shutil.which("c++") is None, reason="no C++ compiler")
def test_the_exact_exponential_is_exact_and_the_fast_one_is_not(tmp_path):
    source, program = tmp_path / "exp2.cpp", tmp_path / "exp2"
    source.write_text(EXP2_PROGRAM)
    subprocess.run(["c++", "-std=c++17", "-O1", f"-I{COMMON}", str(source), "-o", str(program)], check=True)
    said = subprocess.run([str(program)], check=True, capture_output=True, text=True).stdout
    errors = [float(line) / unit for line, unit in zip(said.split(), 2 * (2.0**-23, 2.0**-52), strict=True)]
    # Units in the last place, relative to 1. Rounding alone is 0.5; glibc documents 0.51 for its function.
    assert all(0.5 < e < 2 for e in errors[:2]), errors
    assert all(0.4 < e < 0.52 for e in errors[2:]), errors
    assert errors[2] < errors[0] and errors[3] < errors[1]


def test_the_exact_build_differs_in_that_header_alone(tmp_path):
    copy = exact_exponential.copy_sources(tmp_path)
    original = SHIPPED.parents[2]
    differing = []
    for file in (p for p in copy.rglob("*") if p.is_file()):
        if file.read_bytes() != (original / file.relative_to(copy)).read_bytes():
            differing.append(file.relative_to(copy).as_posix())
    assert differing == ["csrc/math/exp2.h"]
    functions = [re.findall(r"(exp2_\w+)\(\w+ t", path.read_text()) for path in (SHIPPED, copy / differing[0])]
    assert set(functions[0]) <= set(functions[1]) and "exp2_device" in functions[0]


def test_the_figure_takes_what_was_measured(tmp_path):
    pytest.importorskip("matplotlib")
    errors = {name: (1e-6, 0.0 if name == "image" else 1e-8) for name in figure.MARKERS}
    records = [
        {"scene": case.kind, "antialiasing": case.antialiasing, "kernel": str(kernel), "exponential": exponential}
        | {"errors": errors, "milliseconds": milliseconds}
        for case in kernel_runs.CASES
        for exponential in ("fast", "exact")
        for kernel, milliseconds in ((CPU_FLOAT, 70.0), (CPU_DOUBLE, 130.0), (CUDA_FLOAT, 0.7))
    ]
    measured = {"records": records, "machines": ["a machine"], "timed sizes": kernel_runs.TIMED_SIZES}
    figure.draw(measured, tmp_path / "accuracy.png")
    with Image.open(tmp_path / "accuracy.png") as image:
        assert image.size == (1650, 1100)


def test_every_kernel_and_scene_is_provided_for():
    assert {str(kernel) for kernel in (CPU_FLOAT, CPU_DOUBLE, CUDA_FLOAT)} == figure.COLORS.keys()
    assert kernel_runs.TIMED_SIZES.keys() == kernel_runs.KINDS.keys()
