"""Records as code written for the reference makes them, with the reference's fields alone."""

from typing import NamedTuple

import numpy as np


class CameraOf2024(NamedTuple):
    """A view, as the readers of the 2024 release describe it."""

    uid: int
    R: np.ndarray
    T: np.ndarray
    FovY: float
    FovX: float
    depth_params: dict | None
    image_path: str
    image_name: str
    depth_path: str
    width: int
    height: int
    is_test: bool
