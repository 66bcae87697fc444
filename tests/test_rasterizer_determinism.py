"""Determinism: equal results in every run and with any number of threads, and to rounding with any instruction set."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from rasterizer_tools import error, gradients
from torch import Tensor

from benchmarks.workloads.splat_scenes import KINDS, ordinary

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def threads():
    """A function that sets torch's number of threads for this test."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def assert_same_bits(a: dict[str, Tensor], b: dict[str, Tensor]) -> None:
    assert a.keys() == b.keys()
    for name in a:
        assert torch.equal(a[name], b[name]), name


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
def test_any_number_of_threads_gives_the_same_bits(threads, dtype):
    # There are enough splats for several parts in sorts and sums, and enough tiles for threads to take turns.
    scene = ordinary(9000, 203, 117)
    parameters = {name: t.to(dtype) for name, t in scene.parameters.items()}
    camera = scene.settings(dtype, antialiasing=True)
    threads(1)
    wanted = gradients(parameters, camera)
    for count in (2, 3, 3, 1):
        threads(count)
        assert_same_bits(gradients(parameters, camera), wanted)


def results() -> dict[str, Tensor]:
    """Outputs and gradients of three kinds of scene in both precisions, with this process's instruction set."""
    out = {}
    for kind, make in KINDS.items():
        scene = make(300, 75, 53)
        for dtype in (torch.float32, torch.float64):
            parameters = {name: t.float().to(dtype) for name, t in scene.parameters.items()}
            for name, t in gradients(parameters, scene.settings(dtype, antialiasing=True)).items():
                out[f"{kind}, {str(dtype)[6:]}, {name}"] = t
    return out


CHILD = """
import sys, torch
from rasterizer_tools import assert_culling_is_exact, borderline_splats
from test_rasterizer_determinism import results
torch.set_num_threads(1)
for dtype in (torch.float32, torch.float64):
    *projected, left_out = borderline_splats(600, 75, 53, dtype)
    assert_culling_is_exact(*projected, 75, 53, left_out)
torch.save(results(), sys.argv[1])
"""


@pytest.mark.parametrize("isa", ["baseline", "avx2"] if platform.machine() in ("x86_64", "AMD64") else ["baseline"])
def test_instruction_sets_agree_to_rounding(isa, tmp_path):
    """In every instruction set, culling changes no bit."""
    environment = os.environ | {"GS_ISA": isa}
    environment["PYTHONPATH"] = os.pathsep.join([*sys.path, str(ROOT), str(ROOT / "tests")])
    subprocess.run([sys.executable, "-c", CHILD, str(tmp_path / "results.pt")], env=environment, check=True, cwd=ROOT)
    got, wanted = torch.load(tmp_path / "results.pt"), results()
    assert got.keys() == wanted.keys()
    for name, t in wanted.items():
        if t.dtype == torch.int32:
            assert (got[name] - t).abs().max() <= 1
            continue
        # Measured on needles: 6e-6 and 2e-14. A few pixels may differ, those within rounding of 1/255.
        bound = 2e-5 if t.dtype == torch.float32 else 5e-14
        near = (got[name] - t).abs() <= bound * t.abs().max()
        assert near.double().mean() > 0.999, name
        assert error(got[name], t).largest < 0.02, name
