"""Records with COLMAP's own names for cameras, photos and points, and its camera models and quaternions.

Training reads whole models through pycolmap (colmap_model.py). These are for code that reads single files of a model,
with colmap_binary.py and colmap_text.py.
"""

import math
from typing import NamedTuple

import numpy as np

_ROUNDED = 1e-12  # departure of a quaternion's length from 1 that double precision leaves


class CameraModel(NamedTuple):
    """COLMAP's number and name of a camera model, and its number of parameters."""

    model_id: int
    model_name: str
    num_params: int


CAMERA_MODELS = {
    CameraModel(0, "SIMPLE_PINHOLE", 3),
    CameraModel(1, "PINHOLE", 4),
    CameraModel(2, "SIMPLE_RADIAL", 4),
    CameraModel(3, "RADIAL", 5),
    CameraModel(4, "OPENCV", 8),
    CameraModel(5, "OPENCV_FISHEYE", 8),
    CameraModel(6, "FULL_OPENCV", 12),
    CameraModel(7, "FOV", 5),
    CameraModel(8, "SIMPLE_RADIAL_FISHEYE", 4),
    CameraModel(9, "RADIAL_FISHEYE", 5),
    CameraModel(10, "THIN_PRISM_FISHEYE", 12),
    CameraModel(11, "RAD_TAN_THIN_PRISM_FISHEYE", 16),
    CameraModel(12, "SIMPLE_DIVISION", 4),
    CameraModel(13, "DIVISION", 5),
    CameraModel(14, "SIMPLE_FISHEYE", 3),
    CameraModel(15, "FISHEYE", 4),
    CameraModel(16, "EUCM", 6),
    CameraModel(17, "EQUIRECTANGULAR", 2),
}
CAMERA_MODEL_IDS = {model.model_id: model for model in CAMERA_MODELS}
CAMERA_MODEL_NAMES = {model.model_name: model for model in CAMERA_MODELS}


class Camera(NamedTuple):
    """Intrinsics: the camera model by name, width and height in pixels, params (n,) float64 in COLMAP's order."""

    id: int
    model: str
    width: int
    height: int
    params: np.ndarray


class BaseImage(NamedTuple):
    """A photo: world-to-camera qvec (4,) w x y z and tvec (3,), name, 2D points xys (n,2), point3D_ids (n,)."""

    id: int
    qvec: np.ndarray
    tvec: np.ndarray
    camera_id: int
    name: str
    xys: np.ndarray
    point3D_ids: np.ndarray


class Image(BaseImage):
    """A photo that knows its rotation as a matrix."""

    def qvec2rotmat(self) -> np.ndarray:
        """World-to-camera rotation (3,3)."""
        return qvec2rotmat(self.qvec)


class Point3D(NamedTuple):
    """A point: xyz (3,), rgb (3,) to 255, its error in pixels, and the photos and 2D points that see it, (n,) each."""

    id: int
    xyz: np.ndarray
    rgb: np.ndarray
    error: float
    image_ids: np.ndarray
    point2D_idxs: np.ndarray


Points = tuple[np.ndarray, np.ndarray, np.ndarray]  # positions (N,3), colours (N,3) to 255, errors (N,1), float64


def points_of(rows: list[tuple]) -> Points:
    """The columns of rows of position, colour and error."""
    table = np.array(rows, dtype=np.float64).reshape(-1, 7)
    return table[:, :3].copy(), table[:, 3:6].copy(), table[:, 6:].copy()


def qvec2rotmat(qvec: np.ndarray) -> np.ndarray:
    """Rotation (3,3) of a quaternion w x y z of any length; NaN for one of zeros."""
    length = math.hypot(*map(float, qvec))
    if abs(length - 1) > _ROUNDED:
        qvec = np.asarray(qvec) / length if length else np.full(4, np.nan)
    w, x, y, z = (float(value) for value in qvec)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * (w * cross + cross @ cross)


def rotmat2qvec(R: np.ndarray) -> np.ndarray:
    """Unit quaternion (4,) w x y z, w >= 0, of a rotation (3,3); the nearest one if the matrix is not quite a rotation.

    Source: I. Y. Bar-Itzhack, New method for extracting the quaternion from a rotation matrix, 2000.
    """
    R = np.asarray(R, dtype=np.float64)
    trace = np.trace(R)
    # Rows and columns are x y z w. The quaternion is the eigenvector of the largest eigenvalue.
    matrix = np.empty((4, 4))
    matrix[:3, :3] = R + R.T - trace * np.eye(3)
    matrix[:3, 3] = matrix[3, :3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    matrix[3, 3] = trace
    x, y, z, w = np.linalg.eigh(matrix)[1][:, -1]
    return np.array([w, x, y, z]) * (-1 if w < 0 else 1)
