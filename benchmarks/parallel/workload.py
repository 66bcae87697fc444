"""Workloads of the benchmarks over ranks: Gaussians, of which each rank draws its own, and cameras with a photo."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from groundwork.ranks.rows import bound
from scene.cameras import Camera
from scene.images.store import InMemory
from scene.readers.info import CameraInfo
from tests.workloads.splat_scenes import FOV, GPU_WORKLOADS, Draw, frustum, model_rows
from utils.graphics_utils import focal2fov, fov2focal

VIEWS = 8
_PIECE = 1 << 19  # Gaussians of a city that are drawn at a time
# The city: a square of houses and streets, seen from above.
_SIDE = 16.0  # of the square, world units
_CELL = 0.4  # a house and half of the streets around it
_STREET = 0.25  # share of a cell's side
_HIGHEST = 0.8
_WALLS = 0.5  # share of a house's Gaussians that lie on its walls
_HEIGHT, _BEFORE = 7.0, 1.5  # of the camera: above the ground, and outside the square
_DEPTH = 10.0  # of the middle of a view
_DOWN = math.pi / 4


def draw_city(n: int, width: int, sigma_px: float, seed: int, device: torch.device | str) -> dict[str, Tensor]:
    """Draw n Gaussians of the city: raw parameters by name, as in a SplatScene.

    They lie in no order. sigma_px: median size in the middle of an image of that width. Sizes are log-normal (0.8).
    A view of `make_pose` sees some half of them.
    """
    draw = Draw(seed, device)
    ground, within = _SIDE * draw.uniform(n, 2), draw.uniform(n, 3)
    cell = (ground / _CELL).floor()
    height = _HIGHEST * ((cell[:, 0] * 12.9898 + cell[:, 1] * 78.233).sin() * 43758.5).remainder(1.0)
    place = ground / _CELL - cell - 0.5
    half = 0.5 * (1 - _STREET)
    house = (place.abs() < half).all(1)
    wall = house & (within[:, 0] < _WALLS)
    onto = torch.where(within[:, 1:2] < 0.5, place.new_tensor([1.0, 0.0]), place.new_tensor([0.0, 1.0]))
    place = torch.where(wall[:, None], torch.where(onto > 0, half * place.sign(), place), place)
    up = torch.where(wall, height * within[:, 2], torch.where(house, height, 0.0))
    size = math.log(sigma_px * _DEPTH / (width / (2 * math.tan(FOV / 2)))) + 0.8 * draw.normal(n)
    return {"means": torch.cat([(cell + place + 0.5) * _CELL - _SIDE / 2, up[:, None]], 1)} | draw.appearance(size)


def make_pose(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Pose of a camera that looks down into the city from one of its four sides, each time from elsewhere.

    Returns a camera-to-world rotation (3, 3) and a world-to-camera translation (3,).
    """
    turn = side * math.pi / 2
    along = 0.5 * (side // 4 % 3)
    inward = np.array([-math.sin(turn), math.cos(turn), 0.0])
    right = np.array([math.cos(turn), math.sin(turn), 0.0])
    forward = math.cos(_DOWN) * inward - math.sin(_DOWN) * np.array([0.0, 0.0, 1.0])
    rotation = np.stack([right, np.cross(forward, right), forward], 1)
    center = -(_SIDE / 2 + _BEFORE) * inward + along * right + np.array([0.0, 0.0, _HEIGHT])
    return rotation, -rotation.T @ center


@dataclass(frozen=True)
class Workload:
    """A scene of so many Gaussians, whose median size is sigma_px, and an image size.

    crop: of width and height, of which the image only has the middle one in so many parts; so a view sees less.
    """

    name: str
    gaussians: int
    width: int
    height: int
    sigma_px: float
    crop: int = 1

    def changed(self, gaussians: int | None, size: tuple[int, int] | None) -> "Workload":
        """The same with another number of Gaussians or another image size."""
        width, height = size or (self.width, self.height)
        return replace(self, gaussians=gaussians or self.gaussians, width=width, height=height)

    def __str__(self) -> str:
        return f"{self.name}, {self.gaussians / 1e6:g} M, {self.width // self.crop}x{self.height // self.crop}"

    def rows(self, rank: int, size: int, device: torch.device, keep: torch.device) -> dict[str, Tensor]:
        """The Gaussians of a rank, by the model's names, the same for every number of ranks.

        device: draws them. keep: where those of the city are kept.
        """
        first, end = (bound(place, self.gaussians, size) for place in (rank, rank + 1))
        if self.name != "city":
            scene = frustum(self.gaussians, self.width, self.height, self.sigma_px, device=device).parameters
            return {name: values[first:end].clone() for name, values in model_rows(scene).items()}
        rows: dict[str, Tensor] = {}
        for piece in range(first // _PIECE, -(-end // _PIECE)):
            begin = piece * _PIECE
            own = slice(max(first - begin, 0), end - begin)
            drawn = draw_city(_PIECE, self.width, self.sigma_px, piece, device)
            for name, values in model_rows(drawn).items():
                values = values[own]
                if name not in rows:
                    rows[name] = values.new_empty(end - first, *values.shape[1:], device=keep)
                at = max(begin - first, 0)
                rows[name][at : at + len(values)] = values
        return rows

    def cameras(self) -> list[Camera]:
        """VIEWS cameras. In XL all see the same, those of the city stand around it. All have the same photo."""
        size = self.width // self.crop, self.height // self.crop
        fovx, fovy = (focal2fov(fov2focal(FOV, self.width), pixels) for pixels in size)
        photo = InMemory(_make_photo(*size))
        poses = [make_pose(i) if self.name == "city" else (np.eye(3), np.zeros(3)) for i in range(VIEWS)]
        infos = [
            CameraInfo(0, *pose, fovy, fovx, None, "", f"{i}", "", *size, image=photo) for i, pose in enumerate(poses)
        ]
        return [Camera(info, size, i) for i, info in enumerate(infos)]


XL = Workload("XL", *GPU_WORKLOADS["XL"])
CITY = Workload("city", 20_000_000, 3840, 2160, 1.1)
ALL = {workload.name: workload for workload in (XL, CITY)}


def _make_photo(width: int, height: int) -> Tensor:
    """Smooth colours (3, H, W) uint8, so that a training towards them gets somewhere."""
    coarse = torch.rand(
        1, 3, math.ceil(height / 64) + 1, math.ceil(width / 64) + 1, generator=torch.Generator().manual_seed(0)
    )
    fine = torch.nn.functional.interpolate(coarse, (height, width), mode="bilinear", align_corners=False)
    return (255 * fine[0]).to(torch.uint8)
