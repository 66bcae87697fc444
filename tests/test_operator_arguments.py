"""Every tensor of every operator: None, another rank, another dtype and another layout end in an error of Python."""

import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
import torch
from fuzz.operators import Call, sound_calls

ROOT = Path(__file__).parents[1]
REPORT = """
import sys
sys.path[:0] = ["tests", "."]
import utils.host.openmp
from fuzz.operators import outcomes
for outcome in outcomes():
    print("|".join(outcome), flush=True)
"""
RASTERIZER = ("project", "bin", "blend", "blend_vjp", "project_vjp", "rasterize", "rasterize_vjp", "mark_visible")
RASTERIZER += ("blend_rows", "rows_vjp", "pack_splats_", "unpack_splats", "move_runs", "sum_runs")
NEEDLESS = ("means2d", "grad_transmittance", "grad_inverse_depth", "stopped", "words")  # tensors that may be None


@pytest.fixture(scope="module")
def outcomes() -> dict[tuple[str, str], str]:
    """Errors by operator and change; made in another process, because a crash would end this one."""
    done = subprocess.run([sys.executable, "-c", REPORT], cwd=ROOT, capture_output=True, text=True)
    lines = [line.split("|") for line in done.stdout.splitlines()]
    assert done.returncode == 0, f"status {done.returncode} in the change after {lines[-1] if lines else 'none'}"
    return {(name, words): outcome for name, words, outcome in lines}


@cache
def _calls() -> dict[str, Call]:
    return sound_calls()


def _argument(name: str, words: str) -> str:
    """Name of the argument that was changed."""
    place = int(words.split()[1].partition("[")[0])
    return _calls()[name][0].default._schema.arguments[place].name


def test_there_are_as_many_as_operators(outcomes):
    registered = {name for name in torch._C._dispatch_get_all_op_names() if "::" in name}
    ours = {name for name in registered if name.startswith(("diff_gaussian", "fused_ssim", "simple_knn"))}
    assert {name.partition("::")[2] for name in ours} == {name for name, _ in outcomes} and len(outcomes) > 1500


def test_none_is_an_error(outcomes):
    for (name, words), outcome in outcomes.items():
        if words.endswith(" is None") and _argument(name, words) not in NEEDLESS:
            assert outcome.endswith("Error"), (name, words)
            if name in RASTERIZER:
                assert outcome in ("TypeError", "ValueError"), (name, words, outcome)


def test_other_dtypes_and_layouts_are_errors(outcomes):
    wrong = ("float16", "int64", "int32", "bool", "complex64", "sparse", "a number")
    for (name, words), outcome in outcomes.items():
        if words.endswith(wrong):
            assert outcome.endswith("Error"), (name, words)


def test_other_ranks_are_errors(outcomes):
    for (name, words), outcome in outcomes.items():
        if name in RASTERIZER and words.endswith(("one more axis", "is a scalar", "no columns", "one column more")):
            if _argument(name, words) in ("slots", "instances", "layers") and not words.endswith(("axis", "scalar")):
                continue  # they have no columns
            if _argument(name, words) == "like":
                continue  # only its dtype counts
            assert outcome in ("ValueError", "RuntimeError"), (name, words, outcome)
