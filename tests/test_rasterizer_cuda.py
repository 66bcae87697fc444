"""The CUDA backend against the CPU's and against itself. Needs a GPU and a build with CUDA."""

import pytest
import torch
from diff_gaussian_rasterization.optim import adam_, observe_, sparse_adam_
from rasterizer_tools import GPU_MARKS, gradients, scene_arguments

from tests.workloads.splat_scenes import SplatScene, frustum

pytestmark = [*GPU_MARKS]
OPS = torch.ops.diff_gaussian_rasterization


def run(scene: SplatScene, device: str, dtype: torch.dtype = torch.float32) -> dict:
    """All planes, the radii and all gradients of a weighted sum of the planes."""
    parameters = {name: t.float().to(dtype) for name, t in scene.parameters.items()}
    return gradients(parameters, scene.settings(dtype), device)


def test_other_stream():
    scene = frustum(5_000, 200, 150, 3.0, seed=6)
    wanted = run(scene, "cuda")
    with torch.cuda.stream(torch.cuda.Stream()):
        got = run(scene, "cuda")
        torch.cuda.current_stream().synchronize()
    assert all(torch.equal(got[name], wanted[name]) for name in wanted)


def test_gradients_do_not_depend_on_how_many_instances_there_are():
    """Up to 2^20 instances, each has a gradient row, above only processed ones; a splat's gradient is the same."""
    scene = frustum(60_000, 1280, 800, 8.0, seed=11)
    p = scene.parameters
    _, _, rects, counts, _ = OPS.project(*scene_arguments(p, scene.settings(torch.float32)))
    # No tile has splats of both sides: 80 tiles across, the middle is left out.
    left = ((counts > 0) & (rects[:, 2] <= 36)).nonzero().flatten()
    right = ((counts > 0) & (rects[:, 0] >= 44)).nonzero().flatten()
    both = torch.cat((left, right))
    assert (
        counts[left].sum() < 0.9 * 2**20 and counts[both].sum() > 1.1 * 2**20
    )  # the CPU's counts, from which a GPU's may differ
    few, many = (run(SplatScene({k: v[rows] for k, v in p.items()}, 1280, 800), "cuda") for rows in (left, both))
    for name in few:
        if name.startswith("d "):
            assert torch.equal(many[name][: len(left)], few[name]), name


@pytest.mark.parametrize("sparse", [False, True])
def test_a_guarded_step_marks_and_stops_as_on_the_cpu(sparse):
    generator = torch.Generator().manual_seed(9)
    seen = torch.arange(5000) % 3 != 1
    states = []
    for device in ("cpu", "cuda"):
        state = [torch.rand(5000, 45, generator=generator.manual_seed(1)).to(device) for _ in range(3)]
        stopped, loss = torch.zeros(1, dtype=torch.int64, device=device), torch.tensor(0.5, device=device)
        kept = []
        for iteration in range(1, 6):
            gradient = torch.randn(5000, 45, generator=generator).to(device)
            if iteration == 3:
                gradient[::501], gradient[7, 3] = torch.nan, 1e25
            guard = (loss, stopped, iteration)
            if sparse:
                sparse_adam_(state[0], gradient, *state[1:], seen.to(device), 1e-2, 0.9, 0.999, 1e-15, 9, *guard)
            else:
                lists = [[t] for t in (state[0], gradient, *state[1:], torch.tensor(float(iteration)))]
                adam_(*lists, [1e-2], 0.9, 0.999, 1e-15, [9], *guard)
            kept.append([t.nan_to_num(nan=77.0) for t in state])
        assert stopped == 3 and all(torch.equal(a, b) for a, b in zip(kept[2], kept[4], strict=True))
        states.append([t.cpu() for t in kept[4]])
    assert torch.equal(states[0][1] == 77, states[1][1] == 77) and (states[0][1] == 77).any()
    for got, wanted in zip(states[1], states[0], strict=True):
        torch.testing.assert_close(got, wanted, rtol=1e-6, atol=1e-6)  # some units in the last place


def test_density_statistics_are_the_cpus_to_the_bit():
    generator = torch.Generator().manual_seed(10)
    for n in (0, 1, 30_001):
        on_cpu = [torch.zeros(n), torch.zeros(n, 1), torch.zeros(n, 1)]
        on_gpu = [t.cuda() for t in on_cpu]
        for _ in range(5):
            radii = torch.randint(-30, 60, (n,), generator=generator, dtype=torch.int32).clamp_min(0)
            gradient = torch.randn(n, 3, generator=generator)
            observe_(*on_cpu, radii, gradient)
            observe_(*on_gpu, radii.cuda(), gradient.cuda())
        assert all(torch.equal(a, b.cpu()) for a, b in zip(on_cpu, on_gpu, strict=True))


def test_float64_says_what_to_do():
    scene = frustum(10, 20, 20, 3.0)
    with pytest.raises(RuntimeError, match="float32"):
        run(scene, "cuda", torch.float64)
