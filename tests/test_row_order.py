"""Rows along a Morton curve: their order, and what moves with a row."""

import torch
from gaussians import model, parameters

from scene.gaussians.morton import morton_codes, sort_rows, sort_scattered


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
