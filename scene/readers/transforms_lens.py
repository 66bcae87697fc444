"""The lens of a frame of transforms.json, and the circle that its picture fills."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scene.images.lens import PANORAMA, Lens
from utils.graphics_utils import fov2focal
from utils.system_utils import UserError

_BROWN = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
_FISHEYE = ("FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")
_ARIA = "FISHEYE624"  # of Project Aria, with the parameters of COLMAP's RAD_TAN_THIN_PRISM_FISHEYE
_OTHER_LENSES = ("equirectangular", "orthographic")  # the first one's rows are steps of the sine of the latitude
_LARGEST = 1e9  # pixels
_TERMS, _ARIA_TERMS = "k1 k2 k3 k4 p1 p2", "k1 k2 k3 k4 k5 k6 p1 p2 s1 s2 s3 s4"  # in the order of distortion_params
_OTHERS = "fl_x fl_y camera_angle_x camera_angle_y cx cy w h camera_model is_fisheye latlong distortion_params"
FIELDS = {*_OTHERS.split(), *_ARIA_TERMS.split(), "fisheye_crop_radius"}  # that are read


def circle_of(frame: Mapping[str, Any], shared: Mapping[str, Any], width: int, file: Path) -> float | None:
    """The radius, in widths of the photo, of the circle about its middle that a fisheye's picture fills; None: unknown.

    Field: fisheye_crop_radius, in pixels of a photo of this width. UserError for one that is no radius.
    """
    radius = {**shared, **frame}.get("fisheye_crop_radius")
    if radius is None:
        return None
    if not (isinstance(radius, int | float) and 0 < radius <= _LARGEST):
        raise UserError(f"fisheye_crop_radius in {file} must be a number of pixels above 0, got {radius!r:.40}")
    return radius / max(width, 1)


def lens_of(frame: Mapping[str, Any], shared: Mapping[str, Any], size: tuple[int, int], file: Path) -> Lens:
    """The lens of a frame: each value from the frame's own fields, else from those of the whole file.

    Fields: fl_x, fl_y in pixels, or camera_angle_x, camera_angle_y in radians (a missing y equals x); cx, cy (default:
    the middle); w, h (default: `size`, the photo's width and height); camera_model, or is_fisheye; k1 ... k6, p1, p2 as
    in OpenCV, or distortion_params, a list of them. A panorama needs camera_model alone. UserError for a lens that
    cannot be used; TypeError, ValueError, OverflowError for a value that is not a number.
    """
    fields = {**shared, **frame}
    model = str(fields.get("camera_model") or ("FISHEYE" if fields.get("is_fisheye") else "PERSPECTIVE")).upper()
    names = (_ARIA_TERMS if model == _ARIA else _TERMS).split()
    fields = {**_add_terms(shared, names, file), **_add_terms(frame, names, file)}

    def number(name: str, default: float) -> float:
        value = fields.get(name)
        return default if value is None else float(value)

    width, height = int(number("w", size[0])), int(number("h", size[1]))
    if model == "LATLONG" or fields.get("latlong"):
        model = PANORAMA
    other = [name for name, value in fields.items() if value and (name in _OTHER_LENSES or name.startswith("ftheta_p"))]
    if other:
        raise UserError(
            f"{file} has {other[0]}, a lens of instant-ngp that cannot be used; convert the photos to pinhole images"
        )
    if model == PANORAMA:  # of all directions, whatever its focal lengths are said to be
        return Lens(PANORAMA, (width, height), width, height)
    for name in ("camera_angle_x", "camera_angle_y"):
        if not 0 < number(name, 1.0) < np.pi:
            raise UserError(f"{name} in {file} must lie between 0 and pi, got {number(name, 1.0)}; give it in radians")
    if fields.get("fl_x") is None and fields.get("camera_angle_x") is None:
        raise UserError(f"{file} has neither camera_angle_x nor fl_x; export the cameras with one of them")
    fx = number("fl_x", fov2focal(number("camera_angle_x", 1.0), width))
    angle_y = fields.get("camera_angle_y")
    fy = number("fl_y", fx if angle_y is None or fields.get("fl_x") is not None else fov2focal(float(angle_y), height))
    pinhole = (fx, fy, number("cx", width / 2), number("cy", height / 2))
    colmap, terms = _choose_model(model, [number(name, 0.0) for name in _ARIA_TERMS.split()], file)
    return Lens(colmap, (*pinhole, *terms), width, height)


def _add_terms(fields: Mapping[str, Any], names: Sequence[str], file: Path) -> dict[str, Any]:
    """The fields, with those that a list in them stands for."""
    listed = fields.get("distortion_params") or []
    if not isinstance(listed, list) or len(listed) not in (0, len(names)):
        raise UserError(
            f"distortion_params in {file} must be a list of {len(names)} numbers, {' '.join(names)}, got "
            f"{listed!r:.80}; fix it, or give k1 ... p2 as fields"
        )
    return {**fields, **dict(zip(names, listed, strict=False))}


def _choose_model(model: str, terms: Sequence[float], file: Path) -> tuple[str, tuple[float, ...]]:
    """COLMAP's camera model with such a distortion, and its parameters. terms: those of _ARIA_TERMS."""
    k1, k2, k3, k4, k5, k6, p1, p2, *_ = terms
    if model == _ARIA:
        return "RAD_TAN_THIN_PRISM_FISHEYE", tuple(terms)
    if model not in (*_BROWN, *_FISHEYE):
        models = ", ".join((*_BROWN, *_FISHEYE, _ARIA, PANORAMA))
        raise UserError(
            f"the camera_model {model} in {file} cannot be used, only {models}; convert the photos to one of these"
        )
    if model != "FULL_OPENCV" and any((k4 if model in _BROWN else 0.0, k5, k6)):
        # OpenCV divides by 1 + k4 r^2 + ..., nerfstudio adds k4 r^8, and the file does not say which one is meant.
        raise UserError(
            f"{file} has k4, k5 or k6 for the camera_model {model}, on whose meaning programs disagree; set them to 0, "
            "or camera_model to FULL_OPENCV if they are OpenCV's"
        )
    if model in _FISHEYE:
        prism = "THIN_PRISM_FISHEYE", (k1, k2, p1, p2, k3, k4, 0.0, 0.0)
        return prism if p1 or p2 else ("OPENCV_FISHEYE", (k1, k2, k3, k4))
    if not any((k1, k2, k3, k4, k5, k6, p1, p2)):
        return "PINHOLE", ()
    if any((k3, k4, k5, k6)):
        return "FULL_OPENCV", (k1, k2, p1, p2, k3, k4, k5, k6)
    return "OPENCV", (k1, k2, p1, p2)
