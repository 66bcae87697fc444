"""Views by the reference's names: `Camera`, which has a photo, and `MiniCam`, which has none."""

import torch
from torch import Tensor

from scene.view import ZFAR, ZNEAR
from splatting.compat.camera import Camera

__all__ = ["ZFAR", "ZNEAR", "Camera", "MiniCam"]


class MiniCam:
    """A view without a photo: size in pixels, opening angles in radians, transposed (4,4) matrices."""

    def __init__(
        self,
        width: int,
        height: int,
        fovy: float,
        fovx: float,
        znear: float,
        zfar: float,
        world_view_transform: Tensor,
        full_proj_transform: Tensor,
    ) -> None:
        self.image_width = width
        self.image_height = height
        self.FoVy = fovy
        self.FoVx = fovx
        self.znear = znear
        self.zfar = zfar
        self.world_view_transform = world_view_transform
        self.full_proj_transform = full_proj_transform
        # On the CPU: for 16 numbers, a GPU would have to load a library of solvers, which takes a second.
        center = torch.inverse(world_view_transform.cpu())[3, :3]
        self.camera_center = center.to(world_view_transform.device)
