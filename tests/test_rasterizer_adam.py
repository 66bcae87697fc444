"""The fused Adam step, of all rows or of visible ones, against its formula in float64."""

import pytest
import torch
from diff_gaussian_rasterization import optim
from rasterizer_tools import BOTH_AND_GPU, CPU_AND_GPU, adam
from torch import Tensor

BETAS, EPS, RATE = (0.9, 0.999), 1e-15, 0.01


def exact_step(value: Tensor, gradient: Tensor, mean: Tensor, square: Tensor, rows: Tensor | slice, step: int) -> None:
    """One step in double, of step number `step`; 0: without bias correction."""
    mean[rows] = BETAS[0] * mean[rows] + (1 - BETAS[0]) * gradient[rows]
    square[rows] = BETAS[1] * square[rows] + (1 - BETAS[1]) * gradient[rows] ** 2
    first, second = (1 - beta**step if step else 1.0 for beta in BETAS)
    value[rows] -= RATE * (mean[rows] / first) / ((square[rows] / second).sqrt() + EPS)


def take_step(state: list[Tensor], gradient: Tensor, seen: Tensor | None, step: int, columns: int = -1) -> None:
    value, mean, square = state
    if seen is None:
        adam(value, gradient, mean, square, RATE, BETAS, EPS, float(step), columns)
    else:
        optim.sparse_adam_(value, gradient, mean, square, seen, RATE, *BETAS, EPS, columns)


def gradients_of(shape: tuple[int, ...], steps: int, dtype: torch.dtype) -> list[Tensor]:
    """Gradients of sizes 1e-30 to 1e10, one size per row, with signs that change at every step, some exactly zero."""
    generator = torch.Generator().manual_seed(0)
    size = 10 ** torch.linspace(-30, 10, shape[0], dtype=torch.float64).reshape(-1, *[1] * (len(shape) - 1))
    out = [torch.randn(shape, generator=generator, dtype=torch.float64) * size for _ in range(steps)]
    for g in out[::7]:
        g[::3] = 0
    return [g.to(dtype) for g in out]


@pytest.mark.parametrize("sparse", [False, True], ids=["all rows", "visible rows"])
@pytest.mark.parametrize("shape", [(41, 5, 3), (30, 17)])
@BOTH_AND_GPU
def test_fifty_steps_are_the_formulas(device, dtype, shape, sparse):
    generator = torch.Generator().manual_seed(1)
    start = torch.randn(shape, generator=generator, dtype=torch.float64).to(dtype)
    ours = [t.to(device) for t in (start.clone(), torch.zeros_like(start), torch.zeros_like(start))]
    exact = [t.cpu().double() for t in ours]
    never = torch.arange(len(start)) % 7 == 0
    for step, gradient in enumerate(gradients_of(shape, 50, dtype), start=1):
        seen = (torch.rand(len(start), generator=generator) < 0.5) & ~never if sparse else None
        before = [t.cpu().clone() for t in ours]
        take_step(ours, gradient.to(device), seen if seen is None else seen.to(device), step)
        exact_step(exact[0], gradient.double(), *exact[1:], seen if sparse else slice(None), 0 if sparse else step)
        assert not sparse or all(
            torch.equal(old[~seen], new.cpu()[~seen]) for old, new in zip(before, ours, strict=True)
        )
    ours = [t.cpu() for t in ours]
    unit = torch.finfo(dtype).eps
    # Each step rounds the moments by two or three operations of one unit each, and beta fades earlier errors.
    for got, wanted in zip(ours[1:], exact[1:], strict=True):
        spread = wanted.abs().flatten(1).amax(1).reshape(-1, *[1] * (len(shape) - 1))
        assert ((got - wanted).abs() <= 60 * unit * spread + torch.finfo(dtype).tiny).all()
    assert (ours[0] - start).abs().max() > 10 * RATE
    # Fifty updates, each exact to some units, are summed into values of about 4. Without correction m / sqrt(v) is at
    # first up to 3.2.
    most = 4 + (60 * 3.2 if sparse else 20) * RATE
    torch.testing.assert_close(ours[0].double(), exact[0], rtol=0, atol=50 * unit * most)


@CPU_AND_GPU
def test_many_tensors_in_one_call_are_each_by_itself(device):
    """Twenty tensors, more than one launch on a GPU takes, each with its own rate, columns and counter."""
    generator = torch.Generator().manual_seed(4)
    shapes = [(), (7,), (300, 1), (40, 15, 3), (0, 3)] * 4
    *together, gradients = ([torch.randn(shape, generator=generator).to(device) for shape in shapes] for _ in range(4))
    together[2] = [square**2 for square in together[2]]
    alone = [[t.clone() for t in tensors] for tensors in together]
    counters = [torch.tensor(float(i)) for i in range(len(shapes))]
    rates = [0.1 / (1 + i) for i in range(len(shapes))]
    columns = [9 if shape == (40, 15, 3) else -1 for shape in shapes]
    for i, state in enumerate(zip(*alone, strict=True)):
        adam(state[0], gradients[i], *state[1:], rates[i], BETAS, 1e-15, i + 1.0, columns[i])
    optim.adam_(together[0], gradients, *together[1:], counters, rates, *BETAS, 1e-15, columns)
    for got, wanted in zip(together, alone, strict=True):
        assert all(torch.equal(one, other) for one, other in zip(got, wanted, strict=True))
    assert [int(counter) for counter in counters] == list(range(1, len(shapes) + 1))
