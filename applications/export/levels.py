"""Levels of detail of a model: an octree whose leaves hold its Gaussians, and whose inner tiles hold merged ones."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch

from applications.export.grouping import group_splats
from applications.export.merging import covariances, merge_groups
from gaussian_renderer.scored_views import ScoredViews
from groundwork.host.listing import markdown_table
from groundwork.host.progress import Bar
from scene.cameras import Camera
from scene.splats.splats import Splats, selected
from scene.with_splats import model_of
from utils.image_utils import as_float, mean_psnr, pixels_that_count
from utils.system_utils import compute_device

MOST = 4096  # Gaussians of a leaf, about 1 MB
# Gaussians of a tile's children that become one of the tile: half the resolution of a surface. So tiles of all levels
# are of about one size.
GROUP = 4
_DEEPEST = 40  # level of leaves that are not split any more, as of many Gaussians at one place
_REACH = 3.0  # standard deviations of a Gaussian that a box holds


@dataclass(frozen=True)
class Tile:
    """A cell of the octree.

    splats: of a leaf those of the model, else merged from the children's. error: of their places, RMS, in the unit of
    the means; 0 of a leaf, and above the children's of others. low, high: corners (3,) float64 of a box in the means'
    frame, with the Gaussians of all tiles below.
    """

    name: str
    splats: Splats
    children: tuple[Tile, ...]
    error: float
    low: np.ndarray
    high: np.ndarray

    def all(self) -> Iterator[Tile]:
        """Return this tile and all tiles below it."""
        yield self
        for child in self.children:
            yield from child.all()

    def level(self, depth: int) -> list[Tile]:
        """The tiles that show the model at a level: those so far below this one, and leaves above."""
        if not depth or not self.children:
            return [self]
        return [tile for child in self.children for tile in child.level(depth - 1)]

    @property
    def levels(self) -> int:
        return 1 + max((child.levels for child in self.children), default=0)


def build_octree(splats: Splats, most: int = MOST, name: str = "r") -> Tile:
    """The tiles of a model. most: Gaussians of a leaf.

    A cell is split at the middle of the box of its means, so that a far Gaussian does not leave the others in one cell.
    """
    low, high = _find_bounds(splats.means.astype(np.float64))
    if len(splats) <= most or not (high > low).any() or len(name) > _DEEPEST:
        return Tile(name, splats, (), 0.0, *_find_box(splats))
    octants = (splats.means > (low + high) / 2) @ np.array([1, 2, 4])
    children = tuple(build_octree(selected(splats, octants == k), most, f"{name}{k}") for k in np.unique(octants))
    below = join_splats([child.splats for child in children])
    order, starts = group_splats(below, GROUP)
    own, spread = merge_groups(selected(below, order), starts)
    error = max(child.error for child in children) + float(np.sqrt(np.mean(spread**2)))
    corners = [_find_box(own), *((child.low, child.high) for child in children)]
    lows, highs = zip(*corners, strict=True)
    return Tile(name, own, children, error, np.min(lows, axis=0), np.max(highs, axis=0))


def join_splats(several: Sequence[Splats]) -> Splats:
    """Splats of several tiles, one after another."""
    names = ("means", "log_scales", "rotations", "opacity_logits", "sh")
    return replace(several[0], **{name: np.concatenate([getattr(some, name) for some in several]) for name in names})


def _find_bounds(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest corner (3,) of the box of points (N, 3); zeros without points."""
    return (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(3), np.zeros(3))


def _find_box(splats: Splats) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest corner (3,) of a box that holds the Gaussians' extents of _REACH deviations."""
    reach = _REACH * np.sqrt(np.diagonal(covariances(splats), axis1=1, axis2=2))
    low, _ = _find_bounds(splats.means - reach)
    _, high = _find_bounds(splats.means + reach)
    return low, high


class Views(Protocol):
    """Views on which levels are compared, such as `applications.export.formats.SceneInputs`."""

    cameras: Sequence[Camera]
    background: Sequence[float]
    pipe: argparse.Namespace


def make_table(root: Tile, sizes: Sequence[int], around: Views) -> str:
    """Make a Markdown table of the levels, coarsest first: contents, and loss in PSNR. sizes: of the levels, bytes."""
    found = measure_losses(root, around.cameras, around.background, around.pipe)
    best, rows = found[-1]["photos"], []
    for depth, (loss, size) in enumerate(zip(found, sizes, strict=True)):
        tiles = root.level(depth)
        counts = len(tiles), sum(len(tile.splats) for tile in tiles), size
        row = [str(depth), *(f"{count:,}" for count in counts), f"{max(tile.error for tile in tiles):.3g}"]
        same = "equal" if around.cameras else "no views"
        row.append(same if loss["psnr"] is None else f"{loss['psnr']:.2f}")
        if best is not None:
            row += [f"{loss['photos']:.2f}", f"{loss['photos'] - best:+.2f}"]
        rows.append(row)
    header = ["level", "tiles", "Gaussians", "bytes", "error (units)", "dB to the model"]
    return markdown_table(header + ["dB to the photos", "change"] * (best is not None), rows).rstrip("\n")


@torch.no_grad()
def measure_losses(
    root: Tile, cameras: Sequence[Camera], background: Sequence[float], pipe: argparse.Namespace
) -> list[Mapping[str, float | None]]:
    """Measure each level, coarsest first: `psnr` against the full model's images, `photos` against the photos (dB).

    Both are means over the cameras. `psnr` is None where the images are equal, as those of the last level; `photos` is
    None where a camera has no photo.
    """
    models = [model_of(join_splats([tile.splats for tile in root.level(depth)])) for depth in range(root.levels)]
    pipe = argparse.Namespace(**(vars(pipe) | {"antialiasing": root.splats.antialiasing}))
    views = ScoredViews(pipe, torch.tensor(background, device=compute_device()), halves=False)
    have_photos = all(camera.image_path and camera.image_path.is_file() for camera in cameras)
    found = [{"psnr": [], "photos": []} for _ in models]
    for camera in Bar(cameras, desc="Comparing levels", unit="view", leave=False):
        full = views.image(camera, models[-1])
        for model, values in zip(models, found, strict=True):
            image = full if model is models[-1] else views.image(camera, model)
            values["psnr"].append(_compute_psnr(image - full))
            if have_photos:
                values["photos"].append(_compute_psnr(image - as_float(views.target(camera)), views.mask(camera)))
    return [{name: mean_psnr(each) for name, each in values.items()} for values in found]


def _compute_psnr(difference: torch.Tensor, mask: torch.Tensor | None = None) -> float:
    return float(-10 * pixels_that_count(difference, mask).double().square().mean().log10())
