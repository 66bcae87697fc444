"""Seeded scenes of Gaussians and cameras for tests and benchmarks, with raw parameters as in training."""

import math
from dataclasses import dataclass, replace

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings
from torch import Tensor

from scene.gaussians.morton import morton_codes

PARAMETERS = ("means", "opacities", "scales", "rotations", "sh_dc", "sh_rest")
COLUMNS = ("xyz", "opacity", "scaling", "rotation", "f_dc", "f_rest")  # of a model, in the same order
FOV = math.radians(60)
# Arguments of `frustum`: splats, width, height, median pixel sigma.
GPU_WORKLOADS = {
    "S": (100_000, 800, 800, 2.4),
    "M": (1_000_000, 1000, 1000, 1.4),
    "M+": (1_000_000, 1600, 1060, 1.7),
    "4K": (1_000_000, 3840, 2160, 1.7),
    "L": (3_000_000, 1600, 1060, 1.3),
    "XL": (6_000_000, 1600, 1060, 1.1),
}
CPU_WORKLOADS = {
    "S": (5_000, 200, 200, 2.4),
    "M": (50_000, 400, 400, 2.4),
    "L": (300_000, 800, 800, 1.7),
    "wide": (5_000, 400, 400, 8.0),
}


def model_rows(parameters: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return parameters by the names of a model's columns."""
    return {column: parameters[name] for column, name in zip(COLUMNS, PARAMETERS, strict=True)}


@dataclass
class SplatScene:
    """Raw parameters by name (PARAMETERS) and an image size.

    Opacities are logits, scales logarithms, rotations unnormalised w x y z; SH have K = 16 coefficients. camera: of a
    trained scene (kernels/rasterizer.py).
    """

    parameters: dict[str, Tensor]
    width: int
    height: int
    camera: GaussianRasterizationSettings | None = None

    def leaves(self, dtype: torch.dtype) -> dict[str, Tensor]:
        """Return new leaves that require gradients.

        Values are rounded to float32 in every dtype, so that dtypes can be compared. float32 leaves share the scene's
        memory.
        """
        return {k: v.detach().float().to(dtype).requires_grad_() for k, v in self.parameters.items()}

    def to(self, device: torch.device | str) -> "SplatScene":
        """Return the same scene on another device."""
        return replace(self, parameters={k: v.to(device) for k, v in self.parameters.items()})

    def settings(self, dtype: torch.dtype = torch.float64, **changes) -> GaussianRasterizationSettings:
        """Return its camera, or one at the origin facing +z, 60 degrees wide, on the device of the parameters."""
        made = self.camera and self.camera._replace(**changes)
        made = made or settings(self.width, self.height, dtype, **changes)
        tensors = {k: v.to(dtype) for k, v in made._asdict().items() if isinstance(v, Tensor)}
        return move_camera(made._replace(**tensors), self.parameters["means"].device)

    def pinhole(self) -> tuple[Tensor, Tensor, int, int]:
        """Its camera as gsplat takes one: view (4, 4), K (3, 3), width and height."""
        made = self.settings(torch.float32)
        focal = self.width / (2 * made.tanfovx), self.height / (2 * made.tanfovy)
        K = [[focal[0], 0, self.width / 2], [0, focal[1], self.height / 2], [0, 0, 1]]
        return made.viewmatrix.T.contiguous(), made.viewmatrix.new_tensor(K), self.width, self.height


def settings(
    width: int,
    height: int,
    dtype: torch.dtype = torch.float64,
    *,
    view: Tensor | None = None,
    principal: tuple[float, float] = (0.0, 0.0),
    fov: float = FOV,
    tan_ratio: float | None = None,
    **changes,
) -> GaussianRasterizationSettings:
    """Make a pinhole camera that is `fov` radians wide.

    view: (4, 4) world to view, not transposed. principal: offset of the principal point in NDC. tan_ratio: tangent of
    half the vertical field of view over that of half the horizontal one; by default the image's height / width.
    `changes` replace fields of the settings (antialiasing=True, bg=...).
    """
    tan_x = math.tan(fov / 2)
    tan_y = tan_x * height / width if tan_ratio is None else tan_x * tan_ratio
    view = torch.eye(4, dtype=torch.float64) if view is None else view.double()
    projection = torch.zeros(4, 4, dtype=torch.float64)
    projection[0, 0], projection[1, 1] = 1 / tan_x, 1 / tan_y
    projection[0, 2], projection[1, 2] = principal
    projection[2, 2], projection[2, 3], projection[3, 2] = 100 / 99.99, -1 / 99.99, 1
    made = GaussianRasterizationSettings(
        image_height=height,
        image_width=width,
        tanfovx=tan_x,
        tanfovy=tan_y,
        bg=torch.tensor([0.2, 0.5, 0.9], dtype=dtype),
        scale_modifier=1.0,
        viewmatrix=view.T.contiguous().to(dtype),
        projmatrix=(projection @ view).T.contiguous().to(dtype),
        sh_degree=3,
        campos=torch.linalg.inv(view)[:3, 3].contiguous().to(dtype),
        prefiltered=False,
        debug=False,
        antialiasing=False,
    )
    return made._replace(**changes)


def move_camera(camera: GaussianRasterizationSettings, device: torch.device | str) -> GaussianRasterizationSettings:
    """Return the same settings with their tensors on `device`."""
    return camera._replace(**{k: v.to(device) for k, v in camera._asdict().items() if isinstance(v, Tensor)})


class Draw:
    """Seeded numbers on a device; a GPU's differ from the CPU's."""

    def __init__(self, seed: int, device: torch.device | str) -> None:
        self.generator, self._device = torch.Generator(device).manual_seed(seed), device

    def uniform(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self.generator, device=self._device)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self.generator, device=self._device)

    def appearance(self, size: Tensor) -> dict[str, Tensor]:
        """Parameters but means, of logarithmic sizes (n,): axes within a factor of 5, opacities sigmoid(1.5 normal)."""
        n = len(size)
        scales, rotations = size[:, None] + (self.uniform(n, 3) - 0.5) * math.log(5.0), self.normal(n, 4)
        colors = {"sh_dc": (0.8, 1), "sh_rest": (0.1, 15)}
        drawn = {"opacities": 1.5 * self.normal(n, 1), "scales": scales, "rotations": rotations}
        return drawn | {name: factor * self.normal(n, count, 3) for name, (factor, count) in colors.items()}


def frustum(
    n: int, width: int, height: int, sigma_px: float, seed: int = 0, device: torch.device | str = "cpu"
) -> SplatScene:
    """Draw Gaussians uniformly in the frustum at depths 2 to 10.

    The median size is sigma_px, sizes are log-normal (0.8). On a GPU with seed 0, this order of draws gives the tensors
    that the other implementations in kernels/rasterizer.py were measured on.
    """
    draw = Draw(seed, device)
    focal = width / (2 * math.tan(FOV / 2))
    z = 2 + 8 * draw.uniform(n)
    x = (2 * draw.uniform(n) - 1) * 1.02 * (width / (2 * focal)) * z
    y = (2 * draw.uniform(n) - 1) * 1.02 * (height / (2 * focal)) * z
    size = torch.log(sigma_px * z / focal) + 0.8 * draw.normal(n)
    return SplatScene({"means": torch.stack([x, y, z], -1)} | draw.appearance(size), width, height)


def sort_by_morton(scene: SplatScene) -> SplatScene:
    """Sort the rows as trainings do."""
    order = morton_codes(scene.parameters["means"], 1.0).argsort(stable=True)
    return replace(scene, parameters={name: rows[order] for name, rows in scene.parameters.items()})


ORDERS = {"random": lambda scene: scene, "morton": sort_by_morton}


def ordinary(n: int = 2000, width: int = 203, height: int = 117) -> SplatScene:
    """Make Gaussians as in a trained scene; the image size is no multiple of the tile."""
    return frustum(n, width, height, sigma_px=3.0, seed=1)


def needles(n: int = 500, width: int = 203, height: int = 117) -> SplatScene:
    """Make Gaussians a hundred to a million times longer than wide, up to several images long."""
    scene = frustum(n, width, height, sigma_px=1.0, seed=2)
    g = torch.Generator().manual_seed(3)
    scales = scene.parameters["scales"]
    scales[:, 0] += torch.log(10 ** (1.5 + torch.rand(n, generator=g)))
    scales[:, 1:] -= torch.log(10 ** (0.5 + 3 * torch.rand(n, 2, generator=g)))
    return scene


def huge_and_tiny(n: int = 500, width: int = 203, height: int = 117) -> SplatScene:
    """Make Gaussians of which half are a thousandth of a pixel and half a thousand images wide."""
    scene = frustum(n, width, height, sigma_px=1.0, seed=4)
    scene.parameters["scales"][::2] += math.log(1e-3)
    scene.parameters["scales"][1::2] += math.log(1000.0 * width)
    scene.parameters["opacities"][1::2] -= 2.0
    return scene


KINDS = {"ordinary": ordinary, "needles": needles, "huge and tiny": huge_and_tiny}
