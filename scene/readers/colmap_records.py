"""Records with COLMAP's own names for cameras, photos and points, and its camera models and quaternions."""

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


class PointTable(NamedTuple):
    """Points in the order of their file: ids (N,) int64, xyz (N,3), rgb (N,3) to 255, errors (N,) in pixels."""

    ids: np.ndarray
    xyz: np.ndarray
    rgb: np.ndarray
    errors: np.ndarray

    def published(self) -> Points:
        """The columns but the ids, in the form of the reference."""
        return self.xyz.copy(), self.rgb.astype(np.float64), self.errors[:, None].copy()


def qvec2rotmat(qvec: np.ndarray) -> np.ndarray:
    """Rotation (3,3) of a quaternion w x y z of any length; NaN for one of zeros. Rounded as COLMAP's own is."""
    w, x, y, z = map(float, qvec)
    length = math.hypot(w, x, y, z)
    if not abs(length - 1) <= _ROUNDED:
        w, x, y, z = (value / length if length else math.nan for value in (w, x, y, z))
    x2, y2, z2 = 2 * x, 2 * y, 2 * z
    xx, yy, zz = x2 * x, y2 * y, z2 * z
    return np.array(
        [
            [1 - (yy + zz), y2 * x - z2 * w, z2 * x + y2 * w],
            [y2 * x + z2 * w, 1 - (xx + zz), z2 * y - x2 * w],
            [z2 * x - y2 * w, z2 * y + x2 * w, 1 - (xx + yy)],
        ]
    )


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
