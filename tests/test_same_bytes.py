"""Equal results in every run and with any number of threads, and to rounding with any instruction set."""

import functools
import os
import platform
import subprocess
import sys
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path

import pytest
import torch
from diff_gaussian_rasterization.density import add_noise_, penalise_, split_positions
from diff_gaussian_rasterization.optim import sparse_adam_
from fused_ssim import fused_l1_ssim
from rasterizer_tools import BOTH_AND_GPU, adam, error, gradients, ops
from simple_knn._C import distCUDA2
from test_add_noise import GATE, WHERE
from test_add_noise import _gaussians as noisy_gaussians
from test_exchange import reach_of, recorded_by_torch, some_counts, with_empty
from test_fused_ssim import EPS, image_pair, with_gradient
from test_gaussian_step import Case, start_and_camera, step_fused
from test_gradient_rows import Forward, scene_of
from test_simple_knn import cloud
from test_split_positions import _parents as some_parents
from torch import Tensor

from groundwork.host.machine import instruction_set
from tests.workloads.splat_scenes import KINDS, frustum, ordinary

ROOT = Path(__file__).resolve().parents[1]
Results = list[Tensor]
RATE, BETAS, EPS_OF_ADAM = 0.01, (0.9, 0.999), 1e-15


# What is repeated. There are enough splats for several parts in sorts and sums, and enough tiles for threads to take
# turns.


def _rasterize(device: str, dtype: torch.dtype) -> Callable[[], Results]:
    scene = ordinary(9000, 203, 117) if device == "cpu" else frustum(20_000, 333, 222, 3.0, seed=5)
    parameters = {name: t.to(dtype) for name, t in scene.parameters.items()}
    camera = scene.settings(dtype, antialiasing=True)
    camera.viewmatrix.requires_grad_()

    def everything() -> Results:
        camera.viewmatrix.grad = None
        absolute = gradients(parameters, scene.settings(dtype), device, want_absolute_gradient=True)["d means2d"]
        assert absolute[:, 2].any()
        return [absolute, *gradients(parameters, camera, device).values(), camera.viewmatrix.grad]

    return everything


def _rows_of_gaussians(device: str, dtype: torch.dtype, count: int) -> tuple[Results, Tensor]:
    """The state of an optimiser, and which rows are seen."""
    generator = torch.Generator().manual_seed(3)
    start, gradient = (torch.randn(count, 45, generator=generator).to(device, dtype) for _ in range(2))
    return [start, gradient, 0.1 * gradient, gradient**2], (torch.rand(count, generator=generator) < 0.3).to(device)


def _adam(device: str, dtype: torch.dtype) -> Callable[[], Results]:
    state, _ = _rows_of_gaussians(device, dtype, 40_000)

    def step() -> Results:
        results = []
        for columns in (-1, 9):
            results += (copies := [t.clone() for t in state])
            adam(*copies, RATE, BETAS, EPS_OF_ADAM, 7.0, columns)
        return results

    return step


def _sparse_adam(device: str, dtype: torch.dtype) -> Callable[[], Results]:
    state, seen = _rows_of_gaussians(device, dtype, 20_000)
    state[1][::1001] = torch.nan  # which the guard marks
    loss = torch.ones((), device=device, dtype=dtype)

    def step() -> Results:
        copies = [t.clone() for t in state]
        stopped = torch.zeros(1, dtype=torch.int64, device=device)
        sparse_adam_(*copies, seen, RATE, *BETAS, EPS_OF_ADAM, -1, loss, stopped, 3)
        assert stopped == 3 and copies[2].isnan().any()
        return [t.nan_to_num(nan=77.0) for t in (*copies, stopped)]

    return step


def _density(device: str, dtype: torch.dtype) -> Callable[[], Results]:
    """Noise and the children of a split, which are of float32 alone, and the gradients of a penalty."""
    noisy, parents = ([t.to(device) for t in make(20_001)] for make in (noisy_gaussians, some_parents))
    penalised = [torch.randn(5001, width).to(device, dtype) for width in (1, 3, 1, 3)]

    def all_of_it() -> Results:
        means, (logits, log_scales, *changed) = noisy[0].clone(), (t.clone() for t in penalised)
        add_noise_(means, *noisy[1:], **GATE, **WHERE)
        penalise_(logits, log_scales, *changed, opacity=0.3, scale=0.7)
        return [means, split_positions(*parents, **WHERE, draw=1), *changed]

    return all_of_it


def _exchange(device: str, dtype: torch.dtype) -> Callable[[], Results]:
    counts, reach = some_counts("giants").to(device), reach_of("some", device)
    rows = torch.randn(int(counts.sum()), 12).to(device, dtype)
    numbers, *lists = recorded_by_torch(*reach)
    places = torch.randperm(len(counts)).to(device, torch.int32)
    splats = (
        torch.rand(len(reach[0]), 10, device=device, dtype=dtype),
        torch.rand(len(reach[0]), device=device, dtype=dtype),
    )

    def all_of_it() -> Results:
        numbered = with_empty(ops.list_records(*reach)[0], [0] * len(numbers))
        _, *recorded = ops.list_records(*reach, numbered, *splats, int(numbers.sum()))
        assert all(torch.equal(*pair) for pair in zip(recorded[:2], lists, strict=True))
        sums = ops.sum_runs(rows, counts, torch.ones_like(counts), len(counts))
        return [*recorded, sums, ops.sum_runs(rows, counts, counts, len(rows), places)]

    return all_of_it


def _gradient_rows(device: str, dtype: torch.dtype) -> Callable[[], Results]:
    def rows_and_gradients() -> Results:
        forward = Forward.of(*scene_of("giants", device, dtype), True)
        rows = forward.rows(True)
        return [*rows, *forward.rows_vjp(rows, True)]

    return rows_and_gradients


def _gaussian_step(device: str, dtype: torch.dtype) -> Callable[[], Results]:
    case = Case(sparse=True, guarded=True, observed=dtype == torch.float32, count=5000)
    start, camera = start_and_camera(case, device, dtype)

    def step() -> Results:
        state = deepcopy(start)
        step_fused(state, camera, case, 1)
        return state.tensors()

    return step


def _ssim(device: str, dtype: torch.dtype) -> Callable[[], Results]:
    size = (3, 201, 300) if device == "cpu" else (3, 540, 960)
    img1, img2 = (image.to(device) for image in image_pair("noise", size, dtype))

    def loss() -> Results:
        leaf = img1.detach().requires_grad_()
        l1, ssim = fused_l1_ssim(leaf, img2)
        return [l1.detach(), ssim.detach(), torch.autograd.grad(0.8 * l1 - 0.2 * ssim, leaf)[0]]

    return loss


def _distances(device: str, dtype: torch.dtype) -> Callable[[], Results]:
    points = torch.cat([cloud("normal"), cloud("duplicates"), cloud("outliers")]).to(device, dtype)
    return lambda: [distCUDA2(points)]


WORK = [_rasterize, _adam, _sparse_adam, _exchange, _gradient_rows, _gaussian_step, _ssim, _distances, _density]


@BOTH_AND_GPU
@pytest.mark.parametrize("work", WORK, ids=lambda work: work.__name__[1:])
def test_every_run_with_any_number_of_threads_gives_the_same_bytes(work, device, dtype, threads):
    call = work(device, dtype)
    threads(1)
    wanted = [_bytes(t) for t in call()]
    for count in (2, 3, 3, 7) if device == "cpu" else (1,) * 20:
        threads(count)
        if device == "cuda":
            torch.empty(1 << 20, device=device).fill_(torch.nan)  # the next call's temporary memory
        assert [_bytes(t) for t in call()] == wanted, count


def _bytes(tensor: Tensor) -> bytes:
    return tensor.detach().cpu().contiguous().numpy().tobytes()


@functools.cache
def results() -> dict[str, Tensor]:
    """Outputs and gradients in both precisions with this process's instruction set: three kinds of scene, and SSIM."""
    out = {}
    for dtype in (torch.float32, torch.float64):
        for kind, make in KINDS.items():
            scene = make(300, 75, 53)
            parameters = {name: t.float().to(dtype) for name, t in scene.parameters.items()}
            for name, t in gradients(parameters, scene.settings(dtype, antialiasing=True)).items():
                out[f"{kind}, {str(dtype)[6:]}, {name}"] = t
        for pair in ("noise", "bright sky"):
            values = with_gradient(fused_l1_ssim, *image_pair(pair, dtype=dtype), "same")
            for name, t in zip(("l1", "ssim", "gradient"), values, strict=True):
                out[f"SSIM, {pair}, {str(dtype)[6:]}, {name}"] = t
    return out


CHILD = """
import sys, torch
from rasterizer_tools import assert_culling_is_exact, borderline_splats
from test_same_bytes import results
torch.set_num_threads(1)
for dtype in (torch.float32, torch.float64):
    *projected, left_out = borderline_splats(600, 75, 53, dtype)
    assert_culling_is_exact(*projected, 75, 53, left_out)
torch.save(results(), sys.argv[1])
"""


@pytest.mark.slow
@pytest.mark.parametrize("isa", ["baseline", "avx2"] if platform.machine() in ("x86_64", "AMD64") else ["baseline"])
def test_instruction_sets_agree_to_rounding(isa, tmp_path):
    """In every instruction set, culling changes no bit. GS_ISA is read when a library loads."""
    environment = os.environ | {"GS_ISA": isa}
    environment["PYTHONPATH"] = os.pathsep.join([*sys.path, str(ROOT), str(ROOT / "tests")])
    subprocess.run([sys.executable, "-c", CHILD, str(tmp_path / "results.pt")], env=environment, check=True, cwd=ROOT)
    got, wanted = torch.load(tmp_path / "results.pt"), results()
    assert got.keys() == wanted.keys()
    for name, t in wanted.items():
        if name.startswith("SSIM"):  # tolerances as against the reference
            units = 2 if name.endswith("l1") else 8 if name.endswith("ssim") else 40 * t.abs().max()
            assert (got[name] - t).abs().max() <= units * EPS[t.dtype], name
            continue
        if t.dtype == torch.int32:
            assert (got[name] - t).abs().max() <= 1
            continue
        # Measured on needles: 6e-6 and 2e-14. A few pixels may differ, those within rounding of 1/255.
        bound = 2e-5 if t.dtype == torch.float32 else 5e-14
        near = (got[name] - t).abs() <= bound * t.abs().max()
        assert near.double().mean() > 0.999, name
        assert error(got[name], t).largest < 0.02, name
    if isa == "baseline" and instruction_set() != "baseline":
        # This set has no fma: equal bits would mean that GS_ISA was ignored.
        assert not torch.equal(*(of["SSIM, noise, float32, gradient"] for of in (got, wanted)))
