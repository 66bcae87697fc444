"""Views: their matrices for the rasterizer, and their photos.

Matrices are transposed, so that they multiply row vectors from the right. Camera frame: x right, y down, z forward.
"""

import copy
from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from fused_ssim import composite
from torch import Tensor

from groundwork.host.machine import compute_device
from scene.images.masks import TRANSPARENT, Cutout, Opaque
from scene.images.sizes import shrink_mask, shrink_photo, shrink_values
from scene.images.store import ImageStore, InMemory, Picture, Size, Source, has_pixels, image_device
from scene.readers.depth_maps import depth_fit
from scene.readers.info import CameraInfo
from utils.graphics_utils import camera_center, fov2focal, projection, world_to_camera

ZNEAR = 0.01  # ZNEAR and ZFAR only shape the clip depth and cull nothing
ZFAR = 100.0
_OF_POSE = (  # cached properties
    *("numbers", "_tensor"),
    *("world_view_transform", "full_proj_transform", "camera_center", "projection_matrix"),
)


class View:
    """One view at training resolution. Its pictures are decoded when they are first read.

    uid: index in its list; colmap_id: intrinsics id. R (3,3) camera-to-world, T (3,) world-to-camera, NumPy float64;
    a scale of R is divided out of both, and UserError is raised where R is sheared or mirrored.
    FoVx, FoVy: radians. fx, fy, cx, cy: pixels at image_width x image_height, pixel centres at .5 (the rasterizer's
    integer pixel coordinates are half a pixel less). lens: of a photo that is taken as it is, at that size; None: a
    pinhole. world_view_transform, projection_matrix, full_proj_transform: (4,4) float32, transposed; camera_center (3,)
    float32; all on `device`, made when they are first read. columns: the columns that count in loss and scores, None:
    all. exposure_name: the photo's name among the trained exposures where it is not image_name, else None.
    photo_size: (width, height) of its file. pictures: paths of further ones, by names of parts, which are decoded at
    training size (`picture`). depth_has_gaps: whether an inverse depth of 0 is unknown, and not far away.
    """

    has_dataset_pictures = True  # whether no other code has assigned or changed them (scene/cameras.py)

    def __init__(
        self, info: CameraInfo, size: Size, uid: int, columns: slice | None = None, data_device: str = "cuda"
    ) -> None:
        """Make the view of a record at a size (width, height). data_device: device of photos in memory."""
        self.uid, self.colmap_id = uid, info.uid
        self.FoVx, self.FoVy = info.FovX, info.FovY
        self.image_name = info.image_name
        self.exposure_name: str | None = None
        self.image_path = Path(info.image_path) if info.image_path else None
        self.columns = columns
        self.image_width, self.image_height = self._size = size
        self.photo_size = info.file_size or (info.width, info.height)
        self.fx, self.fy = fov2focal(info.FovX, size[0]), fov2focal(info.FovY, size[1])
        offset = 2 * info.cx / info.width - 1, 2 * info.cy / info.height - 1
        self.cx, self.cy = ((off + 1) * pixels / 2 for off, pixels in zip(offset, size, strict=True))
        self.lens = info.native and info.native.scaled(size[0] / info.width, size[1] / info.height)
        self.znear, self.zfar = ZNEAR, ZFAR
        self.device = compute_device()
        self._photo_device = image_device(data_device, self.device)
        self._images: ImageStore | None = None
        self._source, self._mask = self._put_on_device(info.image) or self.image_path, info.mask
        if self._mask and self._mask.meaning == TRANSPARENT:
            self._source, self._mask = Cutout(self.image_path, info.mask), None
        elif info.opaque:
            self._source = Opaque(self.image_path)
        self._ignore_alpha = info.ignore_alpha
        self.depth_has_gaps = getattr(info.depth, "metric", False)
        self._depth = self._put_on_device(info.depth)
        self._reliable = self._depth is not None and depth_fit(info.depth_params).reliable
        self.pictures: dict[str, Source | InMemory] = {}
        self._projection = projection(ZNEAR, ZFAR, self.FoVx, self.FoVy, *offset).numpy()
        self.place(info.R, info.T)

    def _put_on_device(self, source: Source | InMemory | None) -> Source | InMemory | None:
        return InMemory(source.pixels.to(self._photo_device)) if isinstance(source, InMemory) else source

    def place(self, R: np.ndarray, T: np.ndarray) -> None:
        """Give the view another pose: R, T, and the matrices and centre that follow from them."""
        self.R, self.T = R, T
        self._pose = np.array(R), np.array(T)  # R and T may be changed in place
        for name in _OF_POSE:
            self.__dict__.pop(name, None)

    @cached_property
    def numbers(self) -> np.ndarray:
        """The camera as the rasterizer's kernels take it, (51,) float32 on the host.

        In this order: world_view_transform (16), full_proj_transform (16), camera_center (3), projection_matrix (16).

        They follow from the pose of `place`, whatever was assigned, and are rounded from float64 only once.
        """
        view, project = world_to_camera(*self._pose), self._projection
        center = camera_center(self._pose[0], view[:3, 3])
        parts = view.T.reshape(-1), (project @ view).T.reshape(-1), center, project.T.reshape(-1)
        return np.concatenate(parts, dtype=np.float32, casting="same_kind")

    @cached_property
    def _tensor(self) -> Tensor:
        with torch.inference_mode(False):  # training may read what a render in that mode has made
            return torch.from_numpy(self.numbers.copy()).to(self.device)

    @cached_property
    def world_view_transform(self) -> Tensor:
        return self._tensor[:16].view(4, 4)

    @cached_property
    def full_proj_transform(self) -> Tensor:
        return self._tensor[16:32].view(4, 4)

    @cached_property
    def camera_center(self) -> Tensor:
        return self._tensor[32:35]

    @cached_property
    def projection_matrix(self) -> Tensor:
        return self._tensor[35:].view(4, 4)

    def at_size(self, size: tuple[int, int]) -> "View":
        """Copy this view at a smaller size (width, height), with area averages of its pictures.

        Pictures are decoded and averaged now, on `device`; an image that processes share is averaged later, by one of
        them (SharedImage). A column of the copy counts if it covers only columns that count.
        """
        twin, (old, _) = copy.copy(self), self._size
        twin.image_width, twin.image_height = twin._size = size
        twin.fx, twin.fy = fov2focal(self.FoVx, size[0]), fov2focal(self.FoVy, size[1])
        twin.cx, twin.cy = self.cx * size[0] / old, self.cy * size[1] / self._size[1]
        twin.lens = self.lens and self.lens.scaled(size[0] / old, size[1] / self._size[1])
        if self.columns is not None:
            start, stop, _ = self.columns.indices(old)
            twin.columns = slice(-(-start * size[0] // old), stop * size[0] // old)
        twin._photo_device = self.device
        twin._source = self._change_pixels(self._source, lambda photo: shrink_photo(photo, size, self._ignore_alpha))
        twin._mask = self._change_pixels(self._mask, lambda mask: shrink_mask(mask, size))
        twin._depth = self._change_pixels(self._depth, lambda depth: shrink_values(depth, size))
        twin.pictures = {
            name: self._change_pixels(source, lambda values: shrink_photo(values, size, ignore_alpha=True))
            for name, source in self.pictures.items()
        }
        return twin

    def _change_pixels(self, source: Source | InMemory | None, change: Callable[[Tensor], Tensor]) -> InMemory | None:
        """Apply `change` to the pixels of a picture, on `device`: now, or later for an image that processes share."""

        def on_device(pixels: Tensor) -> Tensor:
            return change(pixels.to(self.device, non_blocking=True))

        if source is None or has_pixels(source):
            return source and source.transformed(on_device)
        return self.images.transformed(source, self._size, on_device)

    @property
    def images(self) -> ImageStore:
        """Store of the decoded pictures: the scene's, or one of this view's own."""
        if self._images is None:
            self._images = ImageStore(0, self._photo_device, self.device)
        return self._images

    @images.setter
    def images(self, store: ImageStore) -> None:
        self._images = store

    @property
    def undecoded(self) -> list[Picture]:
        """Sources of photo, mask, depth map and further pictures, each with the size (width, height) to decode it at.

        Empty if they were given as pixels.
        """
        sources = (self._source, self._mask, self._depth, *self.pictures.values())
        return [(s, self._size) for s in sources if s is not None and not has_pixels(s)]

    def _load_pixels(self, source: Source | InMemory) -> Tensor:
        return source.pixels if has_pixels(source) else self.images.get(source, self._size)

    def _load_on_device(self, source: Source | InMemory) -> Tensor:
        return self._load_pixels(source).to(self.device, non_blocking=True)

    def picture(self, name: str) -> Tensor | None:
        """The further picture of a name, (C,H,W) uint8 on `device`; None for a view without one."""
        source = self.pictures.get(name)
        return None if source is None else self._load_on_device(source)

    def ground_truth(self, background: Tensor) -> tuple[Tensor, Tensor | None]:
        """`target` and `counted_pixels`, with one copy of the image to the device for both."""
        pixels = self._load_on_device(self._source)
        return self._target(pixels, background), self._valid_pixels(pixels)

    def target(self, background: Tensor) -> Tensor:
        """Image (3,H,W) that a render of this view over `background` (3,) in [0,1] should equal.

        uint8, meaning value / 255, for a photo without alpha, or whose alpha is a mask; else float32, composited over
        the background.
        """
        return self._target(self._load_on_device(self._source), background)

    def _target(self, pixels: Tensor, background: Tensor) -> Tensor:
        """Compute `target` (3,H,W) from the photo's pixels (3 or 4,H,W) on `device`."""
        if pixels.shape[0] == 3 or self._ignore_alpha:
            return pixels[:3] if pixels.dtype == torch.uint8 else pixels[:3].float()
        if pixels.dtype == torch.uint8:
            return composite(pixels, background.to(self.device))
        pixels = pixels.float()
        return pixels[:3] + (1 - pixels[3:]) * background.to(self.device)[:, None, None]

    @property
    def counts_all_pixels(self) -> bool:
        """True if `counted_pixels` is None for a reason that is known without the photo."""
        return self._mask is None and not self._ignore_alpha

    @property
    def counted_pixels(self) -> Tensor | None:
        """Pixels that count in loss and scores, (1,H,W) bool; None if all count."""
        return self._valid_pixels(self._load_on_device(self._source) if self._ignore_alpha else None)

    def _valid_pixels(self, pixels: Tensor | None) -> Tensor | None:
        """Compute `counted_pixels` (1,H,W) bool from the mask and from the photo's pixels.

        pixels (3 or 4,H,W): uint8 on `device`, 255 is opaque; None where alpha is no mask, as they are not read then.
        """
        counts = None if self._mask is None else self._load_on_device(self._mask) == 255
        if self._ignore_alpha and pixels.shape[0] == 4:
            opaque = pixels[3:] == 255
            counts = opaque if counts is None else counts & opaque
        return counts

    @property
    def depth_reliable(self) -> bool:
        """True if there is an inverse depth map to train on."""
        return self._reliable

    @property
    def target_inverse_depth(self) -> Tensor | None:
        """Inverse depth (1,H,W) float32 on `device`, 1 / world units, 0 where unknown; None without a map."""
        depth = None if self._depth is None else self._load_on_device(self._depth)
        return depth.nan_to_num(0.0) if self.depth_has_gaps else depth
