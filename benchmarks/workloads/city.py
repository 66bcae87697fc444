"""A city from above: a square of houses and streets as Gaussians, drawn piece by piece, so that nobody needs all."""

import math

import numpy as np
import torch
from torch import Tensor

from benchmarks.workloads.splat_scenes import FOV, Draw

SIDE = 16.0  # of the square, world units
_CELL = 0.4  # a house and half of the streets around it
_STREET = 0.25  # share of a cell's side
_HIGHEST = 0.8
_WALLS = 0.5  # share of a house's Gaussians that lie on its walls
_HEIGHT, _BEFORE = 7.0, 1.5  # of the camera: above the ground, and outside the square
_DEPTH = 10.0  # of the middle of a view
_DOWN = math.pi / 4


def city(n: int, width: int, sigma_px: float, seed: int, device: torch.device | str) -> dict[str, Tensor]:
    """Draw n Gaussians of the city: raw parameters by name, as in a SplatScene.

    They lie in no order. sigma_px: median size in the middle of an image of that width. Sizes are log-normal (0.8).
    A view of `look` sees some half of them.
    """
    draw = Draw(seed, device)
    ground, within = SIDE * draw.uniform(n, 2), draw.uniform(n, 3)
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
    return {"means": torch.cat([(cell + place + 0.5) * _CELL - SIDE / 2, up[:, None]], 1)} | draw.appearance(size)


def look(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Pose of a camera that looks down into the city from one of its four sides, each time from elsewhere.

    Returns a camera-to-world rotation (3, 3) and a world-to-camera translation (3,).
    """
    turn = side * math.pi / 2
    along = 0.5 * (side // 4 % 3)
    inward = np.array([-math.sin(turn), math.cos(turn), 0.0])
    right = np.array([math.cos(turn), math.sin(turn), 0.0])
    forward = math.cos(_DOWN) * inward - math.sin(_DOWN) * np.array([0.0, 0.0, 1.0])
    rotation = np.stack([right, np.cross(forward, right), forward], 1)
    center = -(SIDE / 2 + _BEFORE) * inward + along * right + np.array([0.0, 0.0, _HEIGHT])
    return rotation, -rotation.T @ center
