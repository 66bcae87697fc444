"""Signed distances to the surfaces that views show, in blocks of voxels near these surfaces only.

Each voxel has the mean, over the views that see it, of its distance along the view's axis from the depth there, cut off
at TRUNCATION voxels (Curless and Levoy 1996, "A volumetric method for building complex models from range images").
Views count by the pixels that they have for a voxel there.
"""

from collections.abc import Iterator
from itertools import product

import numpy as np
import torch
from torch import Tensor

from scene.cameras import Camera, MiniCam

SIDE = 8  # voxels of a block's edge
TRUNCATION = 4.0  # voxels
BYTES = 10  # of a voxel: distance, weight and number of views
_AT_ONCE = 4096  # blocks that a view is added to
_BITS, _OFFSET = 21, 1 << 20  # of a block's coordinate in its key
_MEMBERS = torch.tensor(list(product(range(SIDE), repeat=3)))


class TooManyBlocks(Exception):
    """The surfaces need more blocks than allowed."""


def _encode_keys(blocks: Tensor) -> Tensor:
    """(N,) int64 keys of block coordinates (N, 3) int64, in whose order x goes before y before z."""
    x, y, z = (blocks + _OFFSET).unbind(1)
    return (x << 2 * _BITS) | (y << _BITS) | z


def _decode_keys(keys: Tensor) -> Tensor:
    mask = (1 << _BITS) - 1
    return torch.stack([keys >> 2 * _BITS, (keys >> _BITS) & mask, keys & mask], 1) - _OFFSET


class Volume:
    """Blocks of voxels. Voxel (i, j, k) has its centre at the voxel's size times (i, j, k)."""

    def __init__(self, voxel: float, device: torch.device) -> None:
        self.voxel = voxel
        self.keys = torch.zeros(0, dtype=torch.int64, device=device)

    def add_blocks(self, camera: Camera | MiniCam, depth: Tensor, most: int) -> None:
        """Add the blocks within the truncation around the depths (H, W), 0: unknown. TooManyBlocks above `most`."""
        rays, known = _make_rays(camera, depth.shape), depth > 0
        rays, depths = rays[known], depth[known]
        for offset in (-TRUNCATION, 0.0, TRUNCATION):
            points = camera.camera_center + rays * (depths + offset * self.voxel)[:, None]
            near = (points / (SIDE * self.voxel)).floor().long()
            near = near[(near.abs() < _OFFSET).all(1)]
            self.keys = torch.unique(torch.cat([self.keys, torch.unique(_encode_keys(near))]))
        if len(self.keys) > most:
            raise TooManyBlocks

    def start(self) -> None:
        """Give the blocks their voxels, before views are added."""
        shape = len(self.keys), SIDE**3
        self.distances = torch.zeros(shape, device=self.keys.device)  # sums over the views, as are the others
        self.weights = torch.zeros(shape, device=self.keys.device)
        self.views = torch.zeros(shape, dtype=torch.int16, device=self.keys.device)

    def add_view(self, camera: Camera | MiniCam, depth: Tensor) -> None:
        """Add what a view says: depth (H, W), 0: unknown."""
        members = _MEMBERS.to(self.keys.device)
        for rows in torch.arange(len(self.keys), device=self.keys.device).split(_AT_ONCE):
            rows = rows[self._find_in_view(camera, rows)]
            places = _decode_keys(self.keys[rows])[:, None] * SIDE + members
            at, axial = _find_pixels(camera, places.reshape(-1, 3).float() * self.voxel, depth.shape)
            seen = depth.flatten()[at.clamp_min(0)]
            away = (seen - axial) / (TRUNCATION * self.voxel)
            counts = (at >= 0) & (seen > 0) & (away > -1)
            weights = torch.where(counts, (camera.image_height * self.voxel / axial).square(), 0)
            self.distances[rows] += (weights * away.clamp(max=1)).view(-1, SIDE**3)
            self.weights[rows] += weights.view(-1, SIDE**3)
            self.views[rows] += counts.view(-1, SIDE**3)

    def _find_in_view(self, camera: Camera | MiniCam, rows: Tensor) -> Tensor:
        """(R,) bool: blocks that reach into a view's pyramid, with some margin."""
        middles = (_decode_keys(self.keys[rows]).float() * SIDE + (SIDE - 1) / 2) * self.voxel
        clip = middles @ camera.full_proj_transform[:3] + camera.full_proj_transform[3]
        radius = SIDE * self.voxel
        steep = camera.full_proj_transform[:3].norm(dim=0)  # by how much a step of one unit changes each at most
        return (clip[:, :2].abs() < clip[:, 3:] + radius * (steep[:2] + steep[3])).all(1)

    def chunks(self, side: int, confirmed: int) -> Iterator[tuple[np.ndarray, ...]]:
        """Cubes of `side` blocks and one voxel more: origin (3,) in voxels, distances, what is known, and weights.

        The last three are dense.

        Known are voxels that at least `confirmed` views have counted.
        """
        blocks = _decode_keys(self.keys)
        for chunk in torch.unique(torch.div(blocks, side, rounding_mode="floor"), dim=0):
            first = chunk * side
            rows = ((blocks >= first) & (blocks <= first + side)).all(1).nonzero()[:, 0]
            size = (side + 1) * SIDE
            places = (((blocks[rows] - first) * SIDE)[:, None] + _MEMBERS.to(blocks)).reshape(-1, 3).unbind(1)
            weights, sums = self.weights[rows].flatten(), self.distances[rows].flatten()
            known = torch.zeros(size, size, size, dtype=torch.bool, device=blocks.device)
            known[places] = self.views[rows].flatten() >= confirmed
            distances = torch.ones(size, size, size, device=blocks.device)
            distances[places] = sums / torch.where(weights > 0, weights, 1)
            dense = torch.zeros_like(distances)
            dense[places] = weights
            end = slice(side * SIDE + 1)
            cut = (values[end, end, end].cpu().numpy() for values in (distances, known, dense))
            yield ((first * SIDE).cpu().numpy(), *cut)


def _make_rays(camera: Camera | MiniCam, size: tuple[int, int]) -> Tensor:
    """(H, W, 3): from the camera's centre to the points of depth 1 in the middles of the pixels."""
    height, width = size
    matrix = camera.full_proj_transform
    y, x = ((torch.arange(n, device=matrix.device) * 2 + 1) / n - 1 for n in size)
    y, x = torch.meshgrid(y, x, indexing="ij")
    # A direction times the columns x, y and w of the matrix is depth * (x, y, 1).
    inverse = torch.linalg.inv(matrix[:3][:, [0, 1, 3]].cpu().double()).to(matrix)
    return torch.stack([x, y, torch.ones_like(x)], 2) @ inverse


def _find_pixels(camera: Camera | MiniCam, points: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Return the indices (N,) of the pixels that show points (N, 3), -1 outside of the view, and depths (N,)."""
    height, width = size
    clip = points @ camera.full_proj_transform[:3] + camera.full_proj_transform[3]
    depths = clip[:, 3]
    x, y = ((clip[:, :2] / depths[:, None] + 1) * clip.new_tensor([width / 2, height / 2])).unbind(1)
    inside = (depths > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    x, y = (torch.where(inside, value, 0).long() for value in (x, y))
    return torch.where(inside, y * width + x, -1), depths
