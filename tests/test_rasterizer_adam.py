"""The fused Adam step against torch.optim.Adam."""

import pytest
import torch
from rasterizer_tools import ops

BETAS = (0.9, 0.999)


def gradients_of(shape: tuple[int, ...], steps: int, dtype: torch.dtype) -> list[torch.Tensor]:
    """Sizes from 1e-30 to 1e10, each row its own, signs changing from step to step, some exactly zero."""
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
        ops.adam_(ours, gradient, mean, square, rate, *BETAS, eps, float(step))
    unit = torch.finfo(dtype).eps
    state = optimizer.state[theirs]
    # Each step rounds the moments anew, two or three operations of one unit each, and beta fades the old ones.
    for got, wanted in ((mean, state["exp_avg"]), (square, state["exp_avg_sq"])):
        spread = wanted.abs().amax(dim=(1, 2), keepdim=True)
        assert ((got - wanted).abs() <= 60 * unit * spread + torch.finfo(dtype).tiny).all()
    assert torch.isfinite(ours).all()
    moved = (theirs.detach() - start).abs()
    assert moved.max() > 10 * rate
    # Fifty updates of up to `rate`, each good to some units, summed into values of about 3.
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
        ops.adam_(whole[0], gradient, *whole[1:], 0.1, *BETAS, 1e-15, step)
        ops.adam_(part[0], gradient, *part[1:], 0.1, *BETAS, 1e-15, step, columns)
    for got, wanted, before in zip(part, whole, (start, 0 * start, 0 * start), strict=True):
        got, wanted, before = (t.reshape(n, 45) for t in (got, wanted, before))
        assert torch.equal(got[:, columns:], before[:, columns:])
        # Rows cut elsewhere into vectors may round a last place otherwise.
        torch.testing.assert_close(got[:, :columns], wanted[:, :columns], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("columns", [-1, 9])
def test_any_number_of_threads_gives_the_same_bits(columns):
    n, before = 40_000, torch.get_num_threads()
    generator = torch.Generator().manual_seed(3)
    start, gradient = torch.randn(n, 45, generator=generator), torch.randn(n, 45, generator=generator)
    results = []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            state = [start.clone(), 0.1 * gradient, gradient**2]
            ops.adam_(state[0], gradient, *state[1:], 0.1, *BETAS, 1e-15, 7.0, columns)
            results.append(state)
    finally:
        torch.set_num_threads(before)
    for state in results[1:]:
        for got, wanted in zip(state, results[0], strict=True):
            assert torch.equal(got, wanted)


def test_wrong_arguments_are_named():
    a, b = torch.zeros(4, 3), torch.zeros(4, 2)
    with pytest.raises(RuntimeError, match="shape and dtype of the parameter"):
        ops.adam_(a, b, a.clone(), a.clone(), 0.1, *BETAS, 1e-15, 1.0)
    with pytest.raises(RuntimeError, match="shape and dtype of the parameter"):
        ops.adam_(a, a.double(), a.clone(), a.clone(), 0.1, *BETAS, 1e-15, 1.0)
    with pytest.raises(RuntimeError, match="must be contiguous"):
        ops.adam_(torch.zeros(3, 4).T, a, a.clone(), a.clone(), 0.1, *BETAS, 1e-15, 1.0)
    with pytest.raises(RuntimeError, match="columns must be at most 3, got 4"):
        ops.adam_(a, a.clone(), a.clone(), a.clone(), 0.1, *BETAS, 1e-15, 1.0, 4)
    empty = torch.zeros(0, 45)
    ops.adam_(empty, empty.clone(), empty.clone(), empty.clone(), 0.1, *BETAS, 1e-15, 1.0)
