"""Spheres and boxes: which pixels see them, and which Gaussians lie in them."""

from typing import Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from scene.cameras import Camera
from scene.readers.start_cloud import focus_of
from scene.scene import Scene
from utils.system_utils import UserError

_NEAR = 0.25  # radius of a region that is found, over the cameras' median distance from its middle


class Shape(Protocol):
    """A region in the frame of a training."""

    def seen(self, camera: Camera) -> Tensor:
        """(1, H, W) bool: the pixels whose rays meet the region."""

    def holds(self, points: Tensor) -> Tensor:
        """(N,) bool: which points (N, 3) lie in it."""

    def facts(self) -> list[float]:
        """Its numbers, for `restored`."""


class Sphere:
    """All points within a radius of a center (3,)."""

    def __init__(self, center: np.ndarray, radius: float) -> None:
        self.center, self.radius = np.asarray(center, dtype=np.float64), float(radius)

    def seen(self, camera: Camera) -> Tensor:
        x, y = _local(camera)
        toward = (self.center @ camera.R + camera.T).tolist()  # in the view
        along = toward[0] * x + toward[1] * y + toward[2]
        beyond = sum(value * value for value in toward) - self.radius**2
        if beyond <= 0:  # the camera is inside
            return torch.ones_like(along, dtype=torch.bool)[None]
        return ((along > 0) & (along * along >= beyond * (x * x + y * y + 1)))[None]

    def holds(self, points: Tensor) -> Tensor:
        away = points.double() - points.new_tensor(self.center, dtype=torch.float64)
        return away.square().sum(1) <= self.radius**2

    def facts(self) -> list[float]:
        return [*self.center.tolist(), self.radius]


class Box:
    """All points between two corners (3,)."""

    def __init__(self, low: np.ndarray, high: np.ndarray) -> None:
        self.low, self.high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)

    def seen(self, camera: Camera) -> Tensor:
        x, y = _local(camera)
        center = -camera.R @ camera.T
        nearest, farthest = torch.zeros_like(x * y), torch.full_like(x * y, torch.inf)
        for axis in range(3):  # of the world; slabs after Kay and Kajiya 1986
            along = camera.R[axis, 0] * x + camera.R[axis, 1] * y + camera.R[axis, 2]
            along = torch.where(along == 0, torch.finfo(along.dtype).tiny, along)
            ends = [(border[axis] - center[axis]) / along for border in (self.low, self.high)]
            nearest = torch.maximum(nearest, torch.minimum(*ends))
            farthest = torch.minimum(farthest, torch.maximum(*ends))
        return (nearest <= farthest)[None]

    def holds(self, points: Tensor) -> Tensor:
        low, high = (points.new_tensor(end, dtype=torch.float64) for end in (self.low, self.high))
        return ((points.double() >= low) & (points.double() <= high)).all(1)

    def facts(self) -> list[float]:
        return [*self.low.tolist(), *self.high.tolist()]


def _local(camera: Camera) -> tuple[Tensor, Tensor]:
    """x (1, W) and y (H, 1) of the rays of a view's pixels at depth 1."""
    x, y = (torch.arange(n, device=camera.device) + 0.5 for n in (camera.image_width, camera.image_height))
    return ((x - camera.cx) / camera.fx)[None], ((y - camera.cy) / camera.fy)[:, None]


def restored(numbers: list[float], origin: ArrayLike = (0, 0, 0)) -> Sphere | Box:
    """A region from `facts`, in a frame with that origin."""
    first, rest = np.subtract(numbers[:3], origin), numbers[3:]
    return Sphere(first, rest[0]) if len(rest) == 1 else Box(first, np.subtract(rest, origin))


def found(numbers: list[float] | None, scene: Scene) -> Sphere | Box:
    """The region in the frame of a training. UserError where it cannot be found, or a view has a lens.

    numbers: as `facts`, in the coordinates of the dataset; None: a sphere around the point that the cameras look at.
    """
    views, offset = scene.info.train_cameras, scene.info.offset
    if any(view.native for view in views):
        raise UserError("--region needs photos without distortion; take --lenses undistort, or leave it out")
    if numbers is not None:
        return restored(numbers, offset)
    focus = focus_of(views)
    if focus is None:
        raise UserError("--region auto finds no point that the cameras look at; give a sphere or a box in numbers")
    point, distance = focus
    shape = Sphere(point, _NEAR * distance)
    x, y, z = (point + offset).tolist()
    print(f'--region auto takes the sphere "{x:.4g} {y:.4g} {z:.4g} {shape.radius:.4g}"')
    return shape
