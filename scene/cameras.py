"""Views: their matrices for the rasterizer, and their photos.

Matrices are transposed, so that they multiply row vectors from the right. Camera frame: x right, y down, z forward.
"""

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from fused_ssim import composite
from torch import Tensor, nn

from scene.images.masks import TRANSPARENT, Cutout, Opaque
from scene.images.sizes import shrink_mask, shrink_photo, shrink_values
from scene.images.store import ImageStore, InMemory, Picture, Size, Source, at_hand, image_device
from scene.readers.depth_maps import depth_fit
from scene.readers.info import CameraInfo
from splatting.compat.camera_forms import SIGNATURE, of_either_form
from splatting.host.machine import compute_device
from utils.graphics_utils import camera_center, fov2focal, projection, world_to_camera

ZNEAR = 0.01  # ZNEAR and ZFAR only shape the clip depth and cull nothing
ZFAR = 100.0
_OF_TARGET = frozenset(("original_image", "alpha_mask"))
_OF_EACH_COPY = ("_assigned", "_made", "_parameters", "_buffers", "_modules")
_NOT_MOVED = np.zeros(3)
# Where the values of these lie in `Camera.numbers`, and their shapes.
_MATRICES = {
    "world_view_transform": (slice(0, 16), (4, 4)),
    "full_proj_transform": (slice(16, 32), (4, 4)),
    "camera_center": (slice(32, 35), (3,)),
    "projection_matrix": (slice(35, 51), (4, 4)),
}
_EDITED = -1  # stands for the version of a tensor that was changed in place; torch counts from 0


def _assignable(compute: Callable[["Camera"], Any]) -> property:
    """A property that is what was assigned to it, and until then, or once that is deleted, what `compute` returns."""
    name = compute.__name__

    def read(camera: "Camera") -> Any:
        return camera._assigned[name] if name in camera._assigned else compute(camera)

    def assign(camera: "Camera", value: Any) -> None:
        camera._assigned[name] = value

    def reset(camera: "Camera") -> None:
        camera._assigned.pop(name, None)
        if name in _OF_TARGET:
            camera._made.clear()

    return property(read, assign, reset, doc=compute.__doc__)


class Camera(nn.Module):
    """One view at training resolution.

    Made of a CameraInfo and the further arguments of `_begin`, or of the arguments of either release of the reference
    (splatting/compat/camera_forms.py).

    uid: index in its list; colmap_id: intrinsics id. R (3,3) camera-to-world, T (3,) world-to-camera, NumPy float64;
    a scale of R is divided out of both, and UserError is raised where R is sheared or mirrored.
    FoVx, FoVy: radians. fx, fy, cx, cy: pixels at image_width x image_height, pixel centres at .5 (the rasterizer's
    integer pixel coordinates are half a pixel less). lens: of a photo that is taken as it is, at that size; None: a
    pinhole. world_view_transform, projection_matrix, full_proj_transform: (4,4) float32, transposed; camera_center (3,)
    float32; all on `device`, made when they are first read. trans, scale: moved the camera's centre c to
    (c + trans) * scale in these. columns: the columns that count in loss and scores, None: all.
    exposure_name: the photo's name among the trained exposures where it is not image_name, else None. data_device:
    where photos in memory lie, and the images and masks below that other code reads.
    All may be assigned, and other attributes added; nothing is computed again from an assigned one. `del` of an
    original_image, alpha_mask, depth_reliable, invdepthmap or depth_mask brings the photo's back.
    depth_has_gaps: whether an inverse depth of 0 is unknown, and not far away.
    A copy shares the store of the decoded photos; what is assigned to it is its own. copy.copy shares tensors,
    copy.deepcopy does not. A pickle leaves the store out, and the photos are decoded again. All keep what was assigned
    and, where the store keeps such images (ImageStore.keeps_floats), changes in place of original_image.
    """

    __signature__ = SIGNATURE

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__()
        if not (args and isinstance(args[0], CameraInfo)):
            args, kwargs = of_either_form(*args, **kwargs)
        self._begin(*args, **kwargs)

    def _begin(
        self,
        info: CameraInfo,
        size: Size,
        uid: int,
        columns: slice | None = None,
        trans: np.ndarray = _NOT_MOVED,
        scale: float = 1.0,
        data_device: str = "cuda",
    ) -> None:
        """The view of a record at a size (width, height). The rest: as the attributes."""
        self.uid, self.colmap_id = uid, info.uid
        self.FoVx, self.FoVy = info.FovX, info.FovY
        self.image_name = info.image_name
        self.exposure_name: str | None = None
        self.image_path = Path(info.image_path) if info.image_path else None
        self.columns = columns
        self.image_width, self.image_height = self._size = size
        self.fx, self.fy = fov2focal(info.FovX, size[0]), fov2focal(info.FovY, size[1])
        offset = 2 * info.cx / info.width - 1, 2 * info.cy / info.height - 1
        self.cx, self.cy = ((off + 1) * pixels / 2 for off, pixels in zip(offset, size, strict=True))
        self.lens = info.native and info.native.scaled(size[0] / info.width, size[1] / info.height)
        self.znear, self.zfar = ZNEAR, ZFAR
        self.trans, self.scale = trans, scale
        self.device = compute_device()
        self.data_device = self._photo_device = image_device(data_device, self.device)
        self._images: ImageStore | None = None
        self._source, self._mask = self._placed(info.image) or self.image_path, info.mask
        if self._mask and self._mask.meaning == TRANSPARENT:
            self._source, self._mask = Cutout(self.image_path, info.mask), None
        elif info.opaque:
            self._source = Opaque(self.image_path)
        self._ignore_alpha = info.ignore_alpha
        self.depth_has_gaps = getattr(info.depth, "metric", False)
        self._depth = self._placed(info.depth)
        self._reliable = self._depth is not None and depth_fit(info.depth_params).reliable
        self._assigned: dict[str, Any] = {}
        self._made: dict[str, Tensor] = {}
        self._made_version = 0
        self._projection = projection(ZNEAR, ZFAR, self.FoVx, self.FoVy, *offset).numpy()
        self.place(info.R, info.T)

    def _placed(self, source: Source | InMemory | None) -> Source | InMemory | None:
        return InMemory(source.pixels.to(self._photo_device)) if isinstance(source, InMemory) else source

    def place(self, R: np.ndarray, T: np.ndarray) -> None:
        """Give it another pose: R, T, and the matrices and centre that follow from them."""
        self.R, self.T = R, T
        self._pose = np.array(R), np.array(T), self.trans, self.scale  # R and T may be changed in place
        self._numbers = self._on_device = None
        for name in _MATRICES:
            self.__dict__.pop(name, None)

    @property
    def numbers(self) -> np.ndarray:
        """Elements (51,) float32 of world_view_transform, full_proj_transform, camera_center and projection_matrix.

        They are those of `place`, whatever was assigned, on the host. Computed in float64, so that they are rounded
        only once.
        """
        if self._numbers is None:
            R, T, trans, scale = self._pose
            view, project = world_to_camera(R, T, trans, scale), self._projection
            center = camera_center(R, view[:3, 3])
            parts = view.T.reshape(-1), (project @ view).T.reshape(-1), center, project.T.reshape(-1)
            self._numbers = np.concatenate(parts, dtype=np.float32, casting="same_kind")
        return self._numbers

    def __getattr__(self, name: str) -> Any:
        if name not in _MATRICES:
            return super().__getattr__(name)
        if self._on_device is None:
            with torch.inference_mode(False):  # training may read what a render in that mode has made
                self._on_device = torch.from_numpy(self.numbers.copy()).to(self.device)
        place, shape = _MATRICES[name]
        values = self.__dict__[name] = self._on_device[place].view(shape)
        return values

    def __setattr__(self, name: str, value: Any) -> None:
        if not isinstance(getattr(type(self), name, None), property):
            super().__setattr__(name, value)
            return
        self._parameters.pop(name, None)
        object.__setattr__(self, name, value)
        if isinstance(value, nn.Parameter):
            self._parameters[name] = value  # torch would refuse the name, since a property has it

    def __delattr__(self, name: str) -> None:
        if isinstance(getattr(type(self), name, None), property):
            self._parameters.pop(name, None)
            object.__delattr__(self, name)
        else:
            super().__delattr__(name)

    def __getstate__(self) -> dict[str, Any]:
        state = {**self.__dict__, "_images": None}
        return state | ({"_made_version": _EDITED} if self._edited else {"_made": {}})

    def __copy__(self) -> "Camera":
        twin = type(self).__new__(type(self))
        twin.__dict__.update(self.__dict__)
        twin.__dict__.update((name, self.__dict__[name].copy()) for name in _OF_EACH_COPY)
        return twin

    def __deepcopy__(self, memo: dict[int, Any]) -> "Camera":
        twin = type(self).__new__(type(self))
        memo[id(self)] = twin
        twin.__setstate__(copy.deepcopy(self.__getstate__(), memo))
        twin._images = self._images
        return twin

    def at_size(self, size: tuple[int, int]) -> "Camera":
        """This view at a smaller size (width, height), with pictures that are area averages of its own.

        They are decoded and computed now, and lie in the copy on `device`; of an image that processes share, one of
        them does so later (SharedImage). Columns that count in it cover no other. What was assigned is left out of it.
        """
        twin, (old, _) = copy.copy(self), self._size
        twin.image_width, twin.image_height = twin._size = size
        twin.fx, twin.fy = fov2focal(self.FoVx, size[0]), fov2focal(self.FoVy, size[1])
        twin.cx, twin.cy = self.cx * size[0] / old, self.cy * size[1] / self._size[1]
        twin.lens = self.lens and self.lens.scaled(size[0] / old, size[1] / self._size[1])
        if self.columns is not None:
            start, stop, _ = self.columns.indices(old)
            twin.columns = slice(-(-start * size[0] // old), stop * size[0] // old)
        twin._assigned, twin._made, twin._photo_device = {}, {}, self.device
        twin._source = self._changed(self._source, lambda photo: shrink_photo(photo, size, self._ignore_alpha))
        twin._mask = self._changed(self._mask, lambda mask: shrink_mask(mask, size))
        twin._depth = self._changed(self._depth, lambda depth: shrink_values(depth, size))
        return twin

    def _changed(self, source: Source | InMemory | None, change: Callable[[Tensor], Tensor]) -> InMemory | None:
        def on_device(pixels: Tensor) -> Tensor:
            return change(pixels.to(self.device, non_blocking=True))

        if source is None or at_hand(source):
            return source and source.changed(on_device)
        return self.images.changed(source, self._size, on_device)

    @property
    def has_dataset_pictures(self) -> bool:
        """Whether its pictures are those of the dataset: nothing was assigned or changed in place."""
        return not self._assigned and not self._edited

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
        """Sources of `target`, `counted_pixels` and `invdepthmap`, each with the size (width, height) to decode it at.

        Empty if they were given as pixels.
        """
        sources = (self._source, self._mask, self._depth)
        return [(s, self._size) for s in sources if s is not None and not at_hand(s)]

    def _stored(self, source: Source | InMemory) -> Tensor:
        return source.pixels if at_hand(source) else self.images.get(source, self._size)

    def _decoded(self, source: Source | InMemory) -> Tensor:
        return self._stored(source).to(self.device, non_blocking=True)

    def _pixels(self) -> Tensor:
        return self._decoded(self._source)

    def _float_pixels(self) -> Tensor:
        """The pixels (3 or 4,H,W) as float in [0,1] on the data device.

        They are kept if the store allows it, because others read them often.
        """
        if "pixels" in self._made:
            return self._made["pixels"]
        with torch.inference_mode(False):  # tensors of that mode count no versions
            pixels = self._stored(self._source).to(self._photo_device)
            pixels = pixels.clone() if pixels.is_floating_point() else pixels.float() / 255
        if isinstance(self._source, InMemory) or self.images.keeps_floats:
            self._made["pixels"], self._made_version = pixels, pixels._version
        return pixels

    @property
    def _edited(self) -> bool:
        """Whether other code changed the kept float pixels in place."""
        return bool(self._made) and self._made["pixels"]._version != self._made_version

    def ground_truth(self, background: Tensor) -> tuple[Tensor, Tensor | None]:
        """`target` and `counted_pixels`, with one copy of the image to the device for both."""
        pixels = self._pixels()
        return self._target(pixels, background), self._counting(pixels)

    def target(self, background: Tensor) -> Tensor:
        """Image (3,H,W) that a render of this view over `background` (3,) in [0,1] should equal.

        uint8, meaning value / 255, for a photo without alpha, or whose alpha is a mask; else float32, composited over
        the background. An original_image or alpha_mask that was assigned or changed in place takes the place of the
        photo's.
        """
        return self._target(self._pixels(), background)

    def _target(self, pixels: Tensor, background: Tensor) -> Tensor:
        if self._edited or not _OF_TARGET.isdisjoint(self._assigned):
            return self._assigned_target(pixels, background.to(self.device))
        if pixels.shape[0] == 3 or self._ignore_alpha:
            return pixels[:3] if pixels.dtype == torch.uint8 else pixels[:3].float()
        if pixels.dtype == torch.uint8:
            return composite(pixels, background.to(self.device))
        pixels = pixels.float()
        return pixels[:3] + (1 - pixels[3:]) * background.to(self.device)[:, None, None]

    def _assigned_target(self, pixels: Tensor, background: Tensor) -> Tensor:
        colors = self.original_image.to(self.device, torch.float32)
        if "alpha_mask" in self._assigned:
            alpha = self.alpha_mask.to(self.device, torch.float32)
        elif pixels.shape[0] == 4 and not self._ignore_alpha:
            alpha = self._float_pixels()[3:].to(self.device, torch.float32)
            if pixels.is_floating_point():
                return colors + (1 - alpha) * background[:, None, None]  # multiplied by alpha already
        else:
            return colors
        return colors * alpha + (1 - alpha) * background[:, None, None]

    @property
    def counts_all_pixels(self) -> bool:
        """Whether `counted_pixels` is None for a reason that is known without the photo."""
        return self._mask is None and not self._ignore_alpha

    @property
    def counted_pixels(self) -> Tensor | None:
        """Pixels that count in loss and scores, (1,H,W) bool; None if all count."""
        return self._counting(self._pixels() if self._ignore_alpha else None)

    def _counting(self, pixels: Tensor | None) -> Tensor | None:
        counts = None if self._mask is None else self._decoded(self._mask) == 255
        if self._ignore_alpha and pixels.shape[0] == 4:
            opaque = pixels[3:] == 255
            counts = opaque if counts is None else counts & opaque
        return counts

    @_assignable
    def original_image(self) -> Tensor:
        """The photo's colours (3,H,W) float32 in [0,1] on the data device; straight alpha is not applied.

        A change in place is a change of `target`, but is lost where the store does not keep such images
        (ImageStore.keeps_floats), as with a limit (--images_to_load). An assigned image is always kept.
        """
        return self._float_pixels()[:3]

    @_assignable
    def alpha_mask(self) -> Tensor:
        """The photo's alpha (1,H,W) float32 in [0,1] on the data device, ones without alpha; 0 outside `columns`.

        Assign another one rather than change it in place: it is made anew at each reading unless the photo has alpha.
        """
        pixels = self._float_pixels()
        alpha = pixels[3:] if pixels.shape[0] == 4 else None
        return self._within_columns(alpha) if alpha is None or self.columns is not None else alpha

    @_assignable
    def depth_reliable(self) -> bool:
        """Whether there is an inverse depth map to train on."""
        return self._reliable

    @_assignable
    def invdepthmap(self) -> Tensor | None:
        """Inverse depth (1,H,W) float32 on the data device, 1 / world units, 0 where unknown; None without a map."""
        depth = None if self._depth is None else self._stored(self._depth).to(self._photo_device)
        return depth.nan_to_num(0.0) if self.depth_has_gaps else depth

    @property
    def target_inverse_depth(self) -> Tensor | None:
        """`invdepthmap`, on `device`."""
        if "invdepthmap" in self._assigned:
            depth = self._assigned["invdepthmap"]
            return None if depth is None else depth.to(self.device)
        depth = None if self._depth is None else self._decoded(self._depth)
        return depth.nan_to_num(0.0) if self.depth_has_gaps else depth

    @_assignable
    def depth_mask(self) -> Tensor | None:
        """(1,H,W) float32 on the data device: 1 where the inverse depth counts, 0 outside `columns`, where it is
        unknown and for an unreliable map; None without a map.
        """
        if self._depth is None:
            return None
        mask = self._within_columns() * float(self._reliable)
        return mask * ~self._stored(self._depth).to(mask).isnan() if self.depth_has_gaps else mask

    def _within_columns(self, values: Tensor | None = None) -> Tensor:
        """Values (1,H,W), ones by default, in the columns that count; 0 elsewhere."""
        mask = torch.zeros(1, *self._size[::-1], device=self._photo_device)
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
        # On the CPU: for 16 numbers, a GPU would have to load a library of solvers, which takes a second.
        center = torch.inverse(world_view_transform.cpu())[3, :3]
        self.camera_center = center.to(world_view_transform.device)
