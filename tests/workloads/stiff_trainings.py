"""Small stiff scenes to train: Gaussians to start from, cameras, and their photos by float64 images.

benchmarks/accuracy/stability_training.py trains them. The photos are of 200 ordinary Gaussians. A training starts from
these, moved, grey and of opacity 0.1, after a kind (KINDS) has made them stiff.
"""

import math
from collections.abc import Callable
from functools import partial

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, rasterize
from torch import Generator, Tensor

from scene.readers.info import origin_near
from tests.workloads.splat_scenes import frustum, settings
from tests.workloads.stability_cases import Parameters, normal, place_means, uniform

WIDTH, HEIGHT, COUNT = 64, 48, 200
VIEWS, HELD_OUT, EXTENT = 8, 4, 2.0  # extent: about 1.1 times the cameras' largest distance from their mean
MIDDLE, FAR = (torch.tensor(v, dtype=torch.float64) for v in ([0.0, 0.0, 6.0], [6e5, 6.4e5, 4.8e5]))
CENTRED = "far unit, offset subtracted"  # as train.py does
Cameras = list[GaussianRasterizationSettings]


def needles(start: Parameters, g: Generator) -> None:
    start["scales"] = start["scales"].mean(1, keepdim=True) + torch.tensor([10, 0.01, 0.01]).log()


def tiny_and_huge(start: Parameters, g: Generator) -> None:
    start["scales"] += math.log(10) * uniform(g, -5, 3, COUNT, 1)


def near(start: Parameters, g: Generator, depth: float = 0.2) -> None:
    """Place every third Gaussian about at a depth in a camera, by default just behind or before the near plane."""
    for k, camera in zip(range(0, COUNT, 3), VIEWS * cameras(VIEWS, torch.zeros(3)), strict=False):
        pixel = uniform(g, 0, 1, 1, 2) * torch.tensor([WIDTH, HEIGHT])
        point = torch.cat([place_means(pixel, depth * (1 + 0.1 * normal(g, 1)), camera)[0], torch.ones(1)])
        start["means"][k] = (point @ torch.linalg.inv(camera.viewmatrix))[:3]
        start["scales"][k] = math.log(3 * depth * 2 * camera.tanfovx / WIDTH)


def opaque(start: Parameters, g: Generator) -> None:
    start["opacities"][:] = math.log(0.9999 / 0.0001)


KINDS: dict[str, Callable | None] = {"plain": None, "needles": needles, "tiny and huge": tiny_and_huge, "near": near}
KINDS |= {"at the camera": partial(near, depth=1e-3), "far unit": None, "opaque": opaque, CENTRED: None}


def cameras(count: int, world: Tensor, **changes) -> Cameras:
    """Cameras in float64 on an arc of a sphere, all facing the middle; world (3,): where the scene's origin is."""
    made = []
    for k in range(count):
        angle = 2 * math.pi * (k + 0.5 * (count == HELD_OUT)) / count
        turn = torch.zeros(3, 3, dtype=torch.float64)
        turn[0, 2], turn[1, 2] = 0.3 * math.cos(angle), 0.2 * math.sin(angle)
        view = torch.eye(4, dtype=torch.float64)
        view[:3, :3] = torch.linalg.matrix_exp(turn - turn.T)
        view[:3, 3] = MIDDLE - view[:3, :3] @ (MIDDLE + world)
        made.append(settings(WIDTH, HEIGHT, view=view, **changes))
    return made


def problem(kind: str, **changes) -> tuple[Parameters, Cameras, list[Tensor]]:
    """A start of float32 values, all cameras and their photos, in float64."""
    g = Generator().manual_seed(5)
    truth = {name: t.double() for name, t in frustum(COUNT, WIDTH, HEIGHT, 3.0, seed=1).parameters.items()}
    start = {name: torch.zeros_like(t) for name, t in truth.items()}
    start["means"], start["scales"] = truth["means"] + 0.05 * normal(g, COUNT, 3), truth["scales"].clone()
    start["opacities"][:], start["rotations"] = math.log(0.1 / 0.9), normal(g, COUNT, 4)
    if KINDS[kind]:
        KINDS[kind](start, g)
    world = FAR if kind.startswith("far") else torch.zeros_like(FAR)
    if kind == CENTRED:
        world = world - torch.from_numpy(origin_near((MIDDLE + world).numpy(), EXTENT))
    truth["means"], start["means"] = truth["means"] + world, start["means"] + world
    views = cameras(VIEWS, world, **changes) + cameras(HELD_OUT, world, **changes)
    photos = [draw(truth, view).clamp(0, 1) for view in views]
    return {name: t.float().double() for name, t in start.items()}, views, photos


def draw(parameters: Parameters, view: GaussianRasterizationSettings, render: Callable = rasterize) -> Tensor:
    others = {name: t for name, t in parameters.items() if name not in ("means", "opacities")}
    means = parameters["means"]
    return render(means, torch.zeros_like(means), parameters["opacities"], view, raw=True, **others).color
