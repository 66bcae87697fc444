"""Intrinsics of Blender, instant-ngp and nerfstudio, in COLMAP's terms."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scene.images.lens import Lens
from utils.graphics_utils import fov2focal
from utils.system_utils import UserError

_BROWN = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
_FISHEYE = ("FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")


def lens_of(frame: Mapping[str, Any], shared: Mapping[str, Any], size: tuple[int, int], file: Path) -> Lens:
    """The lens of a frame: each value from the frame's own fields, else from those of the whole file.

    Fields: fl_x, fl_y in pixels, or camera_angle_x, camera_angle_y in radians (a missing y equals x); cx, cy (default:
    the middle); w, h (default: `size`, the photo's width and height); camera_model, or is_fisheye; k1 ... k6, p1, p2 as
    in OpenCV. UserError for a lens that cannot be used; TypeError, ValueError, OverflowError for a value that is not a
    number.
    """
    fields = {**shared, **frame}

    def number(name: str, default: float) -> float:
        value = fields.get(name)
        return default if value is None else float(value)

    width, height = int(number("w", size[0])), int(number("h", size[1]))
    for name in ("camera_angle_x", "camera_angle_y"):
        if not 0 < number(name, 1.0) < np.pi:
            raise UserError(f"{name} in {file} must lie between 0 and pi, got {number(name, 1.0)}; give it in radians")
    if fields.get("fl_x") is None and fields.get("camera_angle_x") is None:
        raise UserError(f"{file} has neither camera_angle_x nor fl_x; export the cameras with one of them")
    fx = number("fl_x", fov2focal(number("camera_angle_x", 1.0), width))
    angle_y = fields.get("camera_angle_y")
    fy = number("fl_y", fx if angle_y is None or fields.get("fl_x") is not None else fov2focal(float(angle_y), height))
    pinhole = (fx, fy, number("cx", width / 2), number("cy", height / 2))
    k1, k2, k3, k4, k5, k6, p1, p2 = (number(name, 0.0) for name in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"))

    model = str(fields.get("camera_model") or ("FISHEYE" if fields.get("is_fisheye") else "PERSPECTIVE")).upper()
    if model in _FISHEYE:
        return Lens("OPENCV_FISHEYE", (*pinhole, k1, k2, k3, k4), width, height)
    if model not in _BROWN:
        raise UserError(
            f"the camera_model {model} in {file} cannot be used, only {', '.join(_BROWN + _FISHEYE)}; convert the "
            "photos to one of these"
        )
    if not any((k1, k2, k3, k4, k5, k6, p1, p2)):
        return Lens("PINHOLE", pinhole, width, height)
    if model != "FULL_OPENCV" and any((k4, k5, k6)):
        # OpenCV divides by 1 + k4 r^2 + ..., nerfstudio adds k4 r^8, and the file does not say which one is meant.
        raise UserError(
            f"{file} has k4, k5 or k6 for the camera_model {model}, on whose meaning programs disagree; set them to 0, "
            "or camera_model to FULL_OPENCV if they are OpenCV's"
        )
    if any((k3, k4, k5, k6)):
        return Lens("FULL_OPENCV", (*pinhole, k1, k2, p1, p2, k3, k4, k5, k6), width, height)
    return Lens("OPENCV", (*pinhole, k1, k2, p1, p2), width, height)
