"""Views: their matrices for the rasterizer, and their photos.

Matrices are transposed, so that they multiply row vectors from the right. Camera frame: x right, y down, z forward.
"""

import argparse

import numpy as np
import torch
from fused_ssim import composite
from torch import Tensor

from scene.pictures.masks import TRANSPARENT, Cutout
from scene.pictures.resolution import training_size
from scene.pictures.store import ImageStore, Picture, Source
from scene.readers.info import CameraInfo
from utils.graphics_utils import getProjectionMatrix, getWorld2View2

ZNEAR = 0.01  # ZNEAR and ZFAR only shape the clip depth and cull nothing
ZFAR = 100.0


class Camera:
    """One view at training resolution.

    uid: index in its list; colmap_id: intrinsics id. R (3,3) camera-to-world, T (3,) world-to-camera, NumPy float64.
    FoVx, FoVy: radians. fx, fy, cx, cy: pixels at image_width x image_height, pixel centres at .5 (the rasterizer's
    integer pixel coordinates are half a pixel less). world_view_transform, projection_matrix, full_proj_transform:
    (4,4) float32, transposed; camera_center (3,) float32; all on `device`. columns: the columns that count in loss and
    scores, None: all (scene/half_images.py). exposure_name: the photo's name among the trained exposures.
    """

    def __init__(
        self,
        info: CameraInfo,
        uid: int,
        size: tuple[int, int],
        images: ImageStore,
        device: torch.device | str = "cpu",
    ) -> None:
        self.uid = uid
        self.colmap_id = info.uid
        self.R = info.R
        self.T = info.T
        self.FoVx = info.FovX
        self.FoVy = info.FovY
        self.image_name = info.image_name
        self.image_path = info.image_path
        self.exposure_name = info.image_name
        self.columns: slice | None = None
        self.image_width, self.image_height = size
        self.fx = info.fx * self.image_width / info.width
        self.fy = info.fy * self.image_height / info.height
        self.cx = info.cx * self.image_width / info.width
        self.cy = info.cy * self.image_height / info.height
        self.znear = ZNEAR
        self.zfar = ZFAR
        self.device = torch.device(device)
        self._images = images
        self._source = info.image_path
        self._mask = info.mask
        self._ignore_alpha = info.ignore_alpha
        if info.mask is not None and info.mask.meaning == TRANSPARENT:
            self._source, self._mask = Cutout(info.image_path, info.mask), None
        self._depth = info.depth

        # Computed in float64, so that product and inverse are rounded only once.
        view = torch.from_numpy(getWorld2View2(info.R, info.T))
        projection = getProjectionMatrix(
            ZNEAR, ZFAR, self.FoVx, self.FoVy, 2 * info.cx / info.width - 1, 2 * info.cy / info.height - 1
        )
        self.world_view_transform = self._hand_on(view.T)
        self.projection_matrix = self._hand_on(projection.T)
        self.full_proj_transform = self._hand_on((projection @ view).T)
        self.camera_center = self._hand_on(torch.from_numpy(info.center))

    def _hand_on(self, matrix: Tensor) -> Tensor:
        return matrix.to(self.device, torch.float32).contiguous()

    @property
    def pictures(self) -> list[Picture]:
        """Sources of `target`, `mask` and `invdepthmap`, each with the size (width, height) it is decoded at."""
        sources = (self._source, self._mask, self._depth)
        return [(source, (self.image_width, self.image_height)) for source in sources if source is not None]

    def _decoded(self, source: Source) -> Tensor:
        return self._images.get(source, (self.image_width, self.image_height)).to(self.device, non_blocking=True)

    def _pixels(self) -> Tensor:
        return self._decoded(self._source)

    def ground_truth(self, background: Tensor) -> tuple[Tensor, Tensor | None]:
        """`target` and `mask`, with one copy of the image to the device for both."""
        pixels = self._pixels()
        return self._target(pixels, background), self._counting(pixels)

    def target(self, background: Tensor) -> Tensor:
        """Image (3,H,W) that a render of this view over `background` (3,) in [0,1] should equal.

        uint8, meaning value / 255, for a photo without alpha, or whose alpha is a mask; else float32, composited over
        the background.
        """
        return self._target(self._pixels(), background)

    def _target(self, pixels: Tensor, background: Tensor) -> Tensor:
        if pixels.shape[0] == 3 or self._ignore_alpha:
            return pixels[:3]
        return composite(pixels, background.to(self.device))

    @property
    def mask(self) -> Tensor | None:
        """Pixels that count in loss and scores, (1,H,W) bool; None if all count."""
        return self._counting(self._pixels() if self._ignore_alpha else None)

    def _counting(self, pixels: Tensor | None) -> Tensor | None:
        counts = None if self._mask is None else self._decoded(self._mask) == 255
        if self._ignore_alpha and pixels.shape[0] == 4:
            opaque = pixels[3:] == 255
            counts = opaque if counts is None else counts & opaque
        return counts

    @property
    def original_image(self) -> Tensor:
        """The photo's colours (3,H,W) float32 in [0,1], with straight alpha not applied."""
        return self._pixels()[:3].float() / 255

    @property
    def alpha_mask(self) -> Tensor | None:
        """The photo's alpha (1,H,W) float32 in [0,1], 0 outside `columns`; None without alpha if all columns count."""
        pixels = self._pixels()
        alpha = pixels[3:].float() / 255 if pixels.shape[0] == 4 else None
        return alpha if self.columns is None else self._within_columns(alpha)

    @property
    def depth_reliable(self) -> bool:
        """Whether there is an inverse depth map to train on."""
        return self._depth is not None

    @property
    def invdepthmap(self) -> Tensor | None:
        """Inverse depth (1,H,W) float32, 1 / world units; None without a reliable map."""
        if self._depth is None:
            return None
        return self._decoded(self._depth)

    @property
    def depth_mask(self) -> Tensor | None:
        """(1,H,W) float32: 1 where the inverse depth counts, 0 outside `columns`; None without a reliable map."""
        return None if self._depth is None else self._within_columns()

    def _within_columns(self, values: Tensor | None = None) -> Tensor:
        """Values (1,H,W), ones by default, in the columns that count; 0 elsewhere."""
        mask = torch.zeros(1, self.image_height, self.image_width, device=self.device)
        columns = slice(None) if self.columns is None else self.columns
        mask[..., columns] = 1.0 if values is None else values[..., columns]
        return mask


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
        self.camera_center = torch.inverse(world_view_transform)[3, :3]


def cameraList_from_camInfos(
    cam_infos: list[CameraInfo],
    resolution_scale: float,
    args: argparse.Namespace,
    images: ImageStore,
    device: torch.device | str = "cpu",
) -> list[Camera]:
    """Cameras at training size (args.resolution, divided by resolution_scale) that share one store of images."""
    return [
        Camera(info, uid, training_size(*info.file_size, args.resolution, resolution_scale), images, device)
        for uid, info in enumerate(cam_infos)
    ]


def camera_to_JSON(id: int, camera: CameraInfo) -> dict[str, object]:
    """Entry of `cameras.json`, keys in the order that viewers expect: camera-to-world pose, full-size intrinsics."""
    return {
        "id": id,
        "img_name": camera.image_name,
        "width": camera.width,
        "height": camera.height,
        "position": np.asarray(camera.center).tolist(),
        "rotation": [row.tolist() for row in camera.R],
        "fy": camera.fy,
        "fx": camera.fx,
    }
