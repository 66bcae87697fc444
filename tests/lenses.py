"""One realistically distorted lens of every camera model of pycolmap."""

import numpy as np
from diff_gaussian_rasterization.lens import Lens as NativeLens

from scene.images.lens import Lens, import_pycolmap

# Extra parameters in COLMAP's order. At a focal length of 0.75 widths they move the corners by a twentieth or more.
DISTORTIONS = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": (-0.15,),
    "RADIAL": (-0.15, 0.02),
    "OPENCV": (-0.15, 0.02, 0.003, -0.002),
    "FULL_OPENCV": (-0.15, 0.02, 0.003, -0.002, 0.01, 0.02, -0.01, 0.005),
    "OPENCV_FISHEYE": (0.05, -0.01, 0.003, -0.001),
    "SIMPLE_RADIAL_FISHEYE": (0.05,),
    "RADIAL_FISHEYE": (0.05, -0.01),
    "SIMPLE_FISHEYE": (),
    "FISHEYE": (),
    "FOV": (0.8,),
    "THIN_PRISM_FISHEYE": (0.02, -0.01, 0.001, -0.001, 0.003, -0.001, 0.001, -0.001),
    "RAD_TAN_THIN_PRISM_FISHEYE": (0.02, -0.01, 0.003, -0.001, 0.001, 0.0, 0.001, -0.001, 0.001, -0.001, 0.001, 0.0),
    "SIMPLE_DIVISION": (-0.15,),
    "DIVISION": (-0.15,),
    "EUCM": (0.6, 1.1),
}
DISTORTED = [name for name in DISTORTIONS if "PINHOLE" not in name]


def make_lens(model: str, focal: float, width: int, height: int) -> Lens:
    """Make a lens of DISTORTIONS with a focal length in pixels and a principal point slightly off the centre."""
    center = (round(0.52 * width, 1), round(0.48 * height, 1))
    extra = DISTORTIONS[model]
    focals = len(import_pycolmap().Camera.create_from_model_name(1, model, focal, width, height).focal_length_idxs())
    return Lens(model, (focal,) * focals + center + extra, width, height)


def colmap_camera(lens: Lens):
    """Return the pycolmap camera of a lens, which projects and unprojects."""
    return import_pycolmap().Camera(
        model=lens.model, width=lens.width, height=lens.height, params=list(lens.params), camera_id=1
    )


def opencv_pixels(lens: NativeLens, points: np.ndarray) -> np.ndarray:
    """Project points of the camera by a lens of the rasterizer, with OpenCV's formulas. Return (N, 2), centres at .5.

    points: (N, 3).
    """
    across = points[:, :2] / points[:, 2:]
    radius = np.linalg.norm(across, axis=1, keepdims=True)
    if lens.chart == "equidistant":
        across, radius = across * np.arctan(radius) / radius, np.arctan(radius)
    over, under = (
        sum(term * radius ** (2 * power) for power, term in enumerate((1.0, *terms)))
        for terms in (lens.radial, lens.divisor)
    )
    (x, y), (p1, p2), r2 = across.T, lens.tangential, radius[:, 0] ** 2
    aside = 2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return (across * over / under + np.column_stack(aside)) * lens.focal + np.array(lens.center) + 0.5
