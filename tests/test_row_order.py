"""Rows along a Morton curve: the codes against bits by hand, and what moves with a row."""

import numpy as np
import torch
from gaussians import model, parameters

from scene.gaussians.morton import morton_codes, sort_rows, sort_scattered


def _by_hand(point: np.ndarray, scale: float) -> int:
    """Bit 3 k + a of the code is bit k of the cell of axis a, where z is axis 0."""
    place = (point / (np.abs(point) + np.float32(scale))).astype(np.float32)
    cells = np.clip(((place + np.float32(1)) * np.float32(2**20)).astype(np.int64), 0, 2**21 - 1)
    return sum(int(cells[2 - axis] >> k & 1) << (3 * k + axis) for k in range(21) for axis in range(3))


def test_codes_interleave_the_bits_of_cells():
    points = np.random.default_rng(0).normal(size=(200, 3)).astype(np.float32) * np.float32(5)
    points[:4] = [[0, 0, 0], [-0.0, 1e-30, -1e-30], [3e38, -3e38, 0], [1e9, 1, -1e9]]
    codes = morton_codes(torch.from_numpy(points), 2.0)
    assert codes.tolist() == [_by_hand(point, 2.0) for point in points]
    odd = torch.tensor([[float("nan"), float("inf"), 0.0]])
    assert morton_codes(odd, 2.0).item() == _by_hand(np.zeros(3, np.float32), 2.0)


def test_without_memory_rows_move_within_their_own(monkeypatch):
    one, other = model(100, seed=1), model(100, seed=1)
    sort_rows(one)

    select = torch.index_select

    def lacking(values: torch.Tensor, *where: object, **out: object) -> torch.Tensor:
        if values.dim() > 1:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB.")
        return select(values, *where, **out)

    monkeypatch.setattr(torch, "index_select", lacking)
    sort_rows(other)
    monkeypatch.undo()
    for name, values in parameters(one).items():
        assert torch.equal(values, parameters(other)[name]), name


def test_scattered_rows_are_sorted_and_a_model_in_its_order_keeps_it():
    gaussians = model(5000, seed=3)
    scattered = parameters(gaussians)
    sort_scattered(gaussians)
    one = parameters(gaussians)
    sort_rows(gaussians)
    assert all(torch.equal(one[name], values) for name, values in parameters(gaussians).items())
    assert not torch.equal(one["xyz"], scattered["xyz"])
    codes = morton_codes(one["xyz"], gaussians.spatial_lr_scale)
    assert (codes[1:] >= codes[:-1]).all()
    with torch.no_grad():  # as training moves Gaussians after the last sort
        gaussians._xyz += 0.01 * torch.randn(gaussians._xyz.shape, generator=torch.Generator().manual_seed(0))
    moved = parameters(gaussians)
    sort_scattered(gaussians)
    assert torch.equal(parameters(gaussians)["xyz"], moved["xyz"])
    codes = morton_codes(moved["xyz"], gaussians.spatial_lr_scale)
    assert (codes[1:] < codes[:-1]).any()
