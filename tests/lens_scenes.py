"""Cameras with lenses, and Gaussians that they show."""

import math

import numpy as np
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings
from diff_gaussian_rasterization.lens import Lens, lens_of
from lenses import make_lens
from rasterizer_tools import rigid
from torch import Tensor

from tests.workloads import splat_scenes

WIDTH, HEIGHT = 96, 64
PANORAMA = Lens("equirectangular", (WIDTH / (2 * math.pi), HEIGHT / math.pi), (WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5))


def distorted(model: str):
    """A lens of pycolmap's model."""
    return make_lens(model, 28.0 if "FISHEYE" in model else 60.0, WIDTH, HEIGHT)


def lens(model: str) -> Lens:
    """A lens of that model, or of a panorama."""
    return PANORAMA if model == "panorama" else lens_of(model, distorted(model).params)


def view_through(of: Lens | None, dtype: torch.dtype, **more) -> GaussianRasterizationSettings:
    """A turned camera beside the origin; its full projection is not read."""
    view = rigid((0.8, -0.3, 0.5, 0.2), (0.1, -0.2, 0.3))
    return splat_scenes.settings(WIDTH, HEIGHT, dtype, view=view, sh_degree=1, lens=of, **more)


def gaussians(
    of: Lens, camera: GaussianRasterizationSettings, count: int, seed: int = 0, spread: float = 0.85
) -> dict[str, Tensor]:
    """Drawn all over that share of the lens's field, at distances of 1 to 5."""
    rng = np.random.default_rng(seed)
    field = min(of.field(WIDTH, HEIGHT), math.pi - 0.3)
    angle = np.arctan(field) if of.chart == "perspective" else field
    theta, phi = spread * angle * np.sqrt(rng.uniform(0, 1, count)), rng.uniform(0, 2 * math.pi, count)
    away = rng.uniform(1, 5, (count, 1))
    view = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], 1) * away
    matrix = camera.viewmatrix.double().cpu()
    draw = torch.Generator().manual_seed(seed)
    normal = lambda *shape: torch.randn(*shape, generator=draw, dtype=torch.float64)  # noqa: E731
    drawn = {
        "means": (torch.from_numpy(view) - matrix[3, :3]) @ torch.linalg.inv(matrix[:3, :3]),
        "opacities": normal(count, 1),
        "scales": torch.log(0.04 * torch.from_numpy(away)) + 0.4 * normal(count, 3),
        "rotations": normal(count, 4),
        "sh_dc": normal(count, 1, 3),
        "sh_rest": 0.2 * normal(count, 3, 3),
    }
    return {name: values.to(camera.viewmatrix) for name, values in drawn.items()}


def everywhere(of: Lens, camera: GaussianRasterizationSettings, count: int) -> dict[str, Tensor]:
    """Far outside of the image, too; each fifth is so large that its footprint reaches into it."""
    values = gaussians(of, camera, count, spread=1.7 if of.chart == "perspective" else 1.0)
    values["scales"][::5] += 3
    values["opacities"] -= 2
    return values
