"""The fused Adam step against torch.optim.Adam."""

import pytest
import torch
from diff_gaussian_rasterization import optim
from rasterizer_tools import adam

BETAS = (0.9, 0.999)


def gradients_of(shape: tuple[int, ...], steps: int, dtype: torch.dtype) -> list[torch.Tensor]:
    """Gradients of sizes 1e-30 to 1e10, one size per row, with signs that change at every step, some exactly zero."""
    generator = torch.Generator().manual_seed(0)
    size = 10 ** torch.linspace(-30, 10, shape[0], dtype=torch.float64).reshape(-1, *[1] * (len(shape) - 1))
    out = [torch.randn(shape, generator=generator, dtype=torch.float64) * size for _ in range(steps)]
    for g in out[::7]:
        g[::3] = 0
    return [g.to(dtype) for g in out]


@pytest.mark.parametrize("eps", [1e-15, 1e-8])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
def test_fifty_steps_are_torchs(dtype, eps):
    shape, rate = (41, 5, 3), 0.01
    start = torch.randn(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(dtype)
    theirs = torch.nn.Parameter(start.clone())
    optimizer = torch.optim.Adam([theirs], lr=rate, betas=BETAS, eps=eps)
    ours, mean, square = start.clone(), torch.zeros_like(start), torch.zeros_like(start)
    for step, gradient in enumerate(gradients_of(shape, 50, dtype), start=1):
        theirs.grad = gradient.clone()
        optimizer.step()
        adam(ours, gradient, mean, square, rate, BETAS, eps, float(step))
    unit = torch.finfo(dtype).eps
    state = optimizer.state[theirs]
    # Each step rounds the moments by two or three operations of one unit each, and beta fades earlier errors.
    for got, wanted in ((mean, state["exp_avg"]), (square, state["exp_avg_sq"])):
        spread = wanted.abs().amax(dim=(1, 2), keepdim=True)
        assert ((got - wanted).abs() <= 60 * unit * spread + torch.finfo(dtype).tiny).all()
    assert torch.isfinite(ours).all()
    moved = (theirs.detach() - start).abs()
    assert moved.max() > 10 * rate
    # Fifty updates of up to `rate`, each exact to some units, are summed into values of about 3.
    torch.testing.assert_close(ours, theirs.detach(), rtol=0, atol=50 * unit * (4 + 20 * rate))


@pytest.mark.parametrize("columns", [0, 1, 9, 45])
def test_columns_left_out_are_not_touched(columns):
    n = 500
    generator = torch.Generator().manual_seed(2)
    start = torch.randn(n, 15, 3, generator=generator)
    gradient = torch.randn(n, 15, 3, generator=generator)
    whole = [start.clone(), torch.zeros_like(start), torch.zeros_like(start)]
    part = [t.clone() for t in whole]
    for step in (1.0, 2.0):
        adam(whole[0], gradient, *whole[1:], 0.1, BETAS, 1e-15, step)
        adam(part[0], gradient, *part[1:], 0.1, BETAS, 1e-15, step, columns)
    for got, wanted, before in zip(part, whole, (start, 0 * start, 0 * start), strict=True):
        got, wanted, before = (t.reshape(n, 45) for t in (got, wanted, before))
        assert torch.equal(got[:, columns:], before[:, columns:])
        # If vectors start elsewhere in a row, a last place may be rounded differently.
        torch.testing.assert_close(got[:, :columns], wanted[:, :columns], rtol=1e-5, atol=1e-6)


def test_many_tensors_in_one_call_are_each_by_itself():
    """Twenty tensors, more than one launch on a GPU takes, each with its own rate, columns and counter."""
    generator = torch.Generator().manual_seed(4)
    shapes = [(), (7,), (300, 1), (40, 15, 3), (0, 3)] * 4
    together = [[torch.randn(shape, generator=generator) for shape in shapes] for _ in range(3)]
    gradients = [torch.randn(shape, generator=generator) for shape in shapes]
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
