"""Coverage by training views: Gaussians that no view has shown from about the same direction are guesses.

A place is covered as far as a training view has it in its frame and saw it along a similar direction. What stood
between the two does not count. This is asked at the cells of a grid, finer in the middle of the scene, so that it costs
a frame equally much with any number of Gaussians.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from scene.cameras import Camera

_MOST = 64  # training views that are asked
_CELLS = 32  # along each side of the grid
_ALIKE, _OTHER = math.cos(math.radians(25)), math.cos(math.radians(50))  # directions that count fully, and not at all
_RIM = 0.15  # of half a frame, in which its coverage fades, outside of it
_DARK = 0.12  # of the light that is left of a guess


class PointCoverage:
    """Coverage of points (P, 3) of the world by views."""

    def __init__(self, points: Tensor, views: Sequence[Camera]) -> None:
        """Precompute which views have which points in their frame.

        points: (P, 3).
        """
        self._points, self._centers = points, torch.stack([view.camera_center for view in views])
        projections = torch.stack([view.full_proj_transform for view in views])
        clip = points @ projections[:, :3] + projections[:, 3:]  # (views, points, 4)
        outside = clip[..., :2].abs().amax(2) / clip[..., 3].clamp_min(1e-9)
        lenses = [getattr(view, "lens", None) for view in views]
        wide = [lens is not None and lens.chart != "perspective" for lens in lenses]  # all around, or nearly
        wide = torch.tensor(wide, device=points.device)[:, None]
        self._framed = torch.where(wide, 1.0, ((1 + _RIM - outside) / _RIM).clamp(0, 1))
        self._nearness = 1 / torch.cdist(self._centers, points).clamp_min(1e-9)

    def measure(self, eye: Tensor) -> Tensor:
        """Return the coverage (P,) in [0, 1] of the points as seen from `eye` (3,)."""
        rays = torch.nn.functional.normalize(self._points - eye, dim=1)
        cosines = ((rays * self._points).sum(1) - self._centers @ rays.T) * self._nearness
        alike = (cosines - _OTHER).div_(_ALIKE - _OTHER).clamp_(0, 1)
        return alike.mul_(self._framed).amax(0)


class Coverage:
    """A grid of cells around training views. size: of the scene."""

    def __init__(self, views: Sequence[Camera], size: float) -> None:
        """Lay a grid of cells around the views. size: of the scene, in its unit."""
        some = views[:: -(-len(views) // _MOST) or 1]
        self._middle, self._size = torch.stack([view.camera_center for view in some]).mean(0), size
        side = (2 * torch.arange(_CELLS, device=self._middle.device) + 1) / _CELLS - 1
        cells = torch.stack(torch.meshgrid(side, side, side, indexing="ij"), dim=3).reshape(-1, 3)
        self._cells = PointCoverage(self._middle + size * cells / (1 - cells.abs()), some)

    def guesses(self, means: Tensor, eye: Tensor) -> Tensor:
        """(N, 1) in [0, 1]: how far Gaussians with these means (N, 3) are guesses for somebody at `eye` (3,)."""
        places = (means - self._middle) / self._size
        places = places / (1 + places.abs())
        guessed = (1 - self._cells.measure(eye)).reshape(_CELLS, _CELLS, _CELLS)
        guessed = guessed.permute(2, 1, 0)  # grid_sample takes x for the last of the sides
        options = {"padding_mode": "border", "align_corners": False}
        found = torch.nn.functional.grid_sample(guessed[None, None], places[None, None, None], **options)
        return found.reshape(-1, 1)


def darken_guesses(image: Tensor, guesses: Tensor) -> Tensor:
    """An image (3, H, W), darker where its light comes from guesses (1, H, W)."""
    return image * (1 - (1 - _DARK) * guesses.clamp(0, 1))
