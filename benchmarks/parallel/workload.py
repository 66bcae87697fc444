"""Workloads of the benchmarks over ranks: Gaussians, of which each rank draws its own, and cameras with a photo."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from benchmarks.workloads.city import city, look
from benchmarks.workloads.splat_scenes import FOV, GPU_WORKLOADS, frustum
from scene.cameras import Camera
from scene.images.store import InMemory
from scene.readers.info import CameraInfo
from splatting.distributed.rows import bound
from utils.graphics_utils import focal2fov, fov2focal

VIEWS = 8
_PIECE = 1 << 19  # Gaussians of a city that are drawn at a time
# The model's names of a scene's parameters.
_NAMES = {"xyz": "means", "f_dc": "sh_dc", "f_rest": "sh_rest", "opacity": "opacities", "scaling": "scales",
          "rotation": "rotations"}  # fmt: skip


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

    def rows(self, rank: int, size: int, device: torch.device) -> dict[str, Tensor]:
        """The Gaussians of a rank, by the model's names, the same for every number of ranks."""
        first, end = (bound(place, self.gaussians, size) for place in (rank, rank + 1))
        if self.name != "city":
            scene = frustum(self.gaussians, self.width, self.height, self.sigma_px, device=device).parameters
            return {name: scene[ours][first:end].clone() for name, ours in _NAMES.items()}
        rows: dict[str, Tensor] = {}
        for piece in range(first // _PIECE, -(-end // _PIECE)):
            begin = piece * _PIECE
            own = slice(max(first - begin, 0), end - begin)
            drawn = city(_PIECE, self.width, self.sigma_px, piece, device)
            for name, ours in _NAMES.items():
                values = drawn[ours][own]
                if name not in rows:
                    rows[name] = values.new_empty(end - first, *values.shape[1:])
                at = max(begin - first, 0)
                rows[name][at : at + len(values)] = values
        return rows

    def cameras(self) -> list[Camera]:
        """VIEWS cameras. In XL all see the same, those of the city stand around it. All have the same photo."""
        size = self.width // self.crop, self.height // self.crop
        fovx, fovy = (focal2fov(fov2focal(FOV, self.width), pixels) for pixels in size)
        photo = InMemory(_photo(*size))
        poses = [look(i) if self.name == "city" else (np.eye(3), np.zeros(3)) for i in range(VIEWS)]
        infos = [
            CameraInfo(0, *pose, fovy, fovx, None, "", f"{i}", "", *size, image=photo) for i, pose in enumerate(poses)
        ]
        return [Camera(info, size, i) for i, info in enumerate(infos)]


XL = Workload("XL", *GPU_WORKLOADS["XL"])
CITY = Workload("city", 20_000_000, 3840, 2160, 1.1)
ALL = {workload.name: workload for workload in (XL, CITY)}


def _photo(width: int, height: int) -> Tensor:
    """Smooth colours (3, H, W) uint8, so that a training towards them gets somewhere."""
    coarse = torch.rand(
        1, 3, math.ceil(height / 64) + 1, math.ceil(width / 64) + 1, generator=torch.Generator().manual_seed(0)
    )
    fine = torch.nn.functional.interpolate(coarse, (height, width), mode="bilinear", align_corners=False)
    return (255 * fine[0]).to(torch.uint8)
