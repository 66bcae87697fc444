"""The notes of `gsplat.rasterization`, and the lists of tiles among them, which are made when somebody reads them."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

_TILE = 16  # px
_LISTS = ("isect_ids", "flatten_ids", "isect_offsets")


class Meta(dict):
    """A dictionary that makes `isect_ids`, `flatten_ids` and `isect_offsets` at first sight.

    They list the splats of each tile of 16 x 16 pixels that they reach with an alpha of 1/255, nearest first.
    """

    def __init__(
        self,
        notes: dict[str, Any],
        form: tuple[int, ...],
        lists: Sequence[tuple[Tensor, Tensor, Tensor]],
        rows: Sequence[Tensor | None],
    ) -> None:
        """lists: of each image instances, ranges and depths; rows: which of its Gaussians are packed, or None."""
        super().__init__(notes)
        self._form, self._lists, self._rows = form, lists, rows

    def __missing__(self, name: str) -> Tensor:
        """Make the lists of tiles when the name of one is first read. KeyError for other names."""
        if name not in _LISTS:
            raise KeyError(name)
        if self["tile_size"] != _TILE:
            raise ValueError(f"{name} is known for a tile_size of {_TILE} alone, got {self['tile_size']}")
        self.update(zip(_LISTS, self._make_lists(), strict=True))
        return self[name]

    def _make_lists(self) -> tuple[Tensor, Tensor, Tensor]:
        """Ids (I,) int64: image, tile and depth, as bits; numbers (I,) int32 of rows; beginnings (..., C, H, W)."""
        tiles = self["tile_width"] * self["tile_height"]
        ids, numbers, begins, instances_before, rows_before = [], [], [], 0, 0
        for image, ((instances, ranges, depths), rows) in enumerate(zip(self._lists, self._rows, strict=True)):
            of_tile = torch.arange(tiles, device=ranges.device).repeat_interleave(ranges.diff())
            bits = depths.float()[instances].view(torch.int32).long()
            ids.append(((image << tiles.bit_length()) + of_tile << 32) + bits)
            begins.append(ranges[:-1] + instances_before)
            place = instances
            if rows is not None:
                place = torch.empty_like(depths, dtype=torch.int64)
                place[rows] = torch.arange(len(rows), device=rows.device)
                place = place[instances]
            numbers.append(place + rows_before)
            instances_before += len(instances)
            rows_before += len(depths) if rows is None else len(rows)
        begins = torch.cat(begins).int().view(*self._form, self["tile_height"], self["tile_width"])
        return torch.cat(ids), torch.cat(numbers).int(), begins
