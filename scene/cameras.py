"""Views by the reference's names: `Camera`, which has a photo and may be changed, and `MiniCam`, which has none.

`utils.camera_utils` has the functions that make cameras, too; other code may replace them there (`find_replacement`).
"""

import argparse
import copy
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from scene.camera_forms import NOT_MOVED, SIGNATURE, info_from_record, parse_either_form, takes
from scene.images.sizes import training_size
from scene.images.store import InMemory
from scene.readers.info import CameraInfo, photo_size
from scene.view import ZFAR, ZNEAR, View
from utils.graphics_utils import camera_center, fov2focal, rigid_pose
from utils.image_utils import half

__all__ = ["ZFAR", "ZNEAR", "Camera", "MiniCam", "cameraList_from_camInfos", "camera_to_JSON", "loadCam"]

_OF_TARGET = frozenset(("original_image", "alpha_mask"))
_OF_EACH_COPY = ("_assigned", "_made", "_parameters", "_buffers", "_modules")
_EDITED = -1  # stands for the version of a tensor that was changed in place; torch counts from 0


def _assignable(compute: Callable[["Camera"], Any]) -> property:
    """Property with an assignable override; deleting the override restores `compute`."""
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


class Camera(View, nn.Module):
    """A view that may be made, changed, copied and pickled as the reference's class of this name.

    The arguments are those of `scene.view.View` with trans and scale, or of either release of the reference
    (scene/camera_forms.py). trans, scale: the matrices put the camera's centre c at (c + trans) * scale. data_device:
    device of photos in memory, and of the images and masks below that other code reads.

    All attributes may be assigned, and others added; nothing is computed again from an assigned one. An original_image
    or alpha_mask that was assigned or changed in place takes the place of the photo's in `target`. `del` of an
    original_image, alpha_mask, depth_reliable, invdepthmap or depth_mask brings the photo's back; `at_size` leaves out
    what was assigned to them.
    A copy shares the store of the decoded photos; what is assigned to it is its own. copy.copy shares tensors,
    copy.deepcopy does not. A pickle leaves the store out, and the photos are decoded again. All keep what was assigned
    and, where the store keeps such images (ImageStore.keeps_floats), changes in place of original_image.
    """

    __module__ = "scene.cameras"  # by which pickles find it
    __signature__ = SIGNATURE

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Make a camera from a CameraInfo, as View, or from the arguments of either release of the reference."""
        nn.Module.__init__(self)
        if not (args and isinstance(args[0], CameraInfo)):
            args, kwargs = parse_either_form(*args, **kwargs)
        self.trans, self.scale = kwargs.pop("trans", NOT_MOVED), kwargs.pop("scale", 1.0)
        self._assigned: dict[str, Any] = {}
        self._made: dict[str, Tensor] = {}
        self._made_version = 0
        View.__init__(self, *args, **kwargs)
        self.data_device = self._photo_device

    def place(self, R: np.ndarray, T: np.ndarray) -> None:
        super().place(R, T)
        self._pose += (self.trans, self.scale)

    def __setattr__(self, name: str, value: Any) -> None:
        """Assign an attribute; a parameter that takes a property's place is registered as torch's modules do it."""
        if not isinstance(getattr(type(self), name, None), property):
            super().__setattr__(name, value)
            return
        self._parameters.pop(name, None)
        object.__setattr__(self, name, value)
        if isinstance(value, nn.Parameter):
            self._parameters[name] = value  # torch would refuse the name, since a property has it

    def __delattr__(self, name: str) -> None:
        """Delete an attribute; a property goes back to its computed value."""
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
        """Copy the camera and its tensors; the copy shares the store of decoded photos."""
        twin = type(self).__new__(type(self))
        memo[id(self)] = twin
        twin.__setstate__(copy.deepcopy(self.__getstate__(), memo))
        twin._images = self._images
        return twin

    def at_size(self, size: tuple[int, int]) -> "Camera":
        twin = super().at_size(size)
        twin._assigned, twin._made = {}, {}
        return twin

    @property
    def has_dataset_pictures(self) -> bool:
        """True if no picture of the dataset was replaced or changed in place."""
        return not self._assigned and not self._edited

    def _float_pixels(self) -> Tensor:
        """The pixels (3 or 4,H,W) as float in [0,1] on the data device.

        They are kept if the store allows it, because others read them often.
        """
        if "pixels" in self._made:
            return self._made["pixels"]
        with torch.inference_mode(False):  # tensors of that mode count no versions
            pixels = self._load_pixels(self._source).to(self._photo_device)
            pixels = pixels.clone() if pixels.is_floating_point() else pixels.float() / 255
        if isinstance(self._source, InMemory) or self.images.keeps_floats:
            self._made["pixels"], self._made_version = pixels, pixels._version
        return pixels

    @property
    def _edited(self) -> bool:
        """True if other code changed the kept float pixels in place."""
        return bool(self._made) and self._made["pixels"]._version != self._made_version

    def _target(self, pixels: Tensor, background: Tensor) -> Tensor:
        if self._edited or not _OF_TARGET.isdisjoint(self._assigned):
            return self._compute_assigned_target(pixels, background.to(self.device))
        return super()._target(pixels, background)

    def _compute_assigned_target(self, pixels: Tensor, background: Tensor) -> Tensor:
        """Return the target (3,H,W) float32 with assigned or changed colours and alpha over `background` (3,)."""
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

    @_assignable
    def original_image(self) -> Tensor:
        """The photo's colours (3,H,W) float32 in [0,1] on the data device; straight alpha is not applied.

        A change in place is a change of `target`, but is lost where the store does not keep such images
        (ImageStore.keeps_floats), as with a limit (--images_to_load). An assigned image is always kept.
        """
        return self._float_pixels()[:3]

    @_assignable
    def alpha_mask(self) -> Tensor:
        """The photo's alpha (1,H,W) float32 in [0,1] on the data device, ones without alpha.

        It is 0 outside `columns`, the columns of pixels that count in loss and scores (None: all).

        Assign another one rather than change it in place: it is made anew at each reading unless the photo has alpha.
        """
        pixels = self._float_pixels()
        alpha = pixels[3:] if pixels.shape[0] == 4 else None
        return self._mask_columns(alpha) if alpha is None or self.columns is not None else alpha

    @_assignable
    def depth_reliable(self) -> bool:
        """Tell whether there is an inverse depth map to train on."""
        return self._reliable

    @_assignable
    def invdepthmap(self) -> Tensor | None:
        """Inverse depth (1,H,W) float32 on the data device, 1 / world units, 0 where unknown; None without a map."""
        depth = None if self._depth is None else self._load_pixels(self._depth).to(self._photo_device)
        return depth.nan_to_num(0.0) if self.depth_has_gaps else depth

    @property
    def target_inverse_depth(self) -> Tensor | None:
        """Inverse depth (1,H,W) to train on, 1 / world units, on `device`: an assigned `invdepthmap`, or the map's."""
        if "invdepthmap" not in self._assigned:
            return super().target_inverse_depth
        depth = self._assigned["invdepthmap"]
        return None if depth is None else depth.to(self.device)

    @_assignable
    def depth_mask(self) -> Tensor | None:
        """The pixels whose inverse depth counts, (1,H,W) float32 on the data device; None without a map.

        1 where it counts; 0 where it is unknown, outside `columns` (the columns of pixels that count in loss and
        scores, None: all), and everywhere for an unreliable map.
        """
        if self._depth is None:
            return None
        mask = self._mask_columns() * float(self._reliable)
        return mask * ~self._load_pixels(self._depth).to(mask).isnan() if self.depth_has_gaps else mask

    def _mask_columns(self, values: Tensor | None = None) -> Tensor:
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
        """Make a view of a size in pixels. fovy, fovx: radians. znear, zfar: only shape the clip depth.

        world_view_transform, full_proj_transform: (4,4), transposed.
        """
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


def find_replacement(name: str) -> Callable[..., Any] | None:
    """Find other code's replacement of a function below, in utils.camera_utils or in this package; else None."""
    ours, modules = globals()[name], filter(None, map(sys.modules.get, (__package__, "utils.camera_utils")))
    return next((own for module in modules if (own := vars(module).get(name, ours)) is not ours), None)


def loadCam(
    args: argparse.Namespace,
    id: int,
    cam_info: CameraInfo,
    resolution_scale: float,
    is_nerf_synthetic: bool = False,
    is_test_dataset: bool = False,
) -> Camera:
    """Camera at training size (args.resolution, divided by resolution_scale), whose photo is decoded on first use.

    args: resolution, data_device and train_test_exp count. id: uid of the camera. cam_info: a CameraInfo, or any record
    with the reference's fields. is_nerf_synthetic: depth maps named by `depth_path` have Blender's unit.
    is_test_dataset: the view is in the test list. UserError for a photo or depth map that cannot be read.
    """
    size = training_size(*photo_size(cam_info), args.resolution, resolution_scale)
    halved = getattr(args, "train_test_exp", False) and getattr(cam_info, "is_test", False)
    columns = half(size[0], is_test_dataset) if halved else None
    return Camera(info_from_record(cam_info, size, is_nerf_synthetic), size, id, columns, data_device=args.data_device)


def cameraList_from_camInfos(
    cam_infos: Sequence[CameraInfo],
    resolution_scale: float,
    args: argparse.Namespace,
    is_nerf_synthetic: bool = False,
    is_test_dataset: bool = False,
) -> list[Camera]:
    """Call `loadCam`, or other code's replacement, for each view; uids count from 0."""
    load, of_2024 = find_replacement("loadCam") or loadCam, (is_nerf_synthetic, is_test_dataset)
    more = of_2024 if takes(load, (args, 0, None, resolution_scale, *of_2024)) else ()
    return [load(args, uid, info, resolution_scale, *more) for uid, info in enumerate(cam_infos)]


def camera_to_JSON(id: int, camera: CameraInfo) -> dict[str, object]:
    """Entry of `cameras.json`, keys in the order that viewers expect: camera-to-world pose, full-size intrinsics.

    camera: any object with R, T, FovX, FovY, width, height and image_name; its fx and fy count if it has them.
    """
    focal = {"fy": ("FovY", "height"), "fx": ("FovX", "width")}
    R, T = rigid_pose(camera.R, camera.T, camera.image_name)
    return {
        "id": id,
        "img_name": camera.image_name,
        "width": camera.width,
        "height": camera.height,
        "position": camera_center(R, T).tolist(),
        "rotation": [row.tolist() for row in np.asarray(R)],
        **{
            name: getattr(camera, name, None) or fov2focal(getattr(camera, fov), getattr(camera, size))
            for name, (fov, size) in focal.items()
        },
    }
