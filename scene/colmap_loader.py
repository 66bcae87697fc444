"""The reference's name for the readers of COLMAP models: of single files, and of whole models."""

from scene.readers.colmap_binary import (
    read_colmap_bin_array,
    read_extrinsics_binary,
    read_intrinsics_binary,
    read_next_bytes,
    read_points3D_binary,
)
from scene.readers.colmap_model import (
    ColmapModel,
    ColmapView,
    Sightings,
    find_model,
    points_file,
    read_model,
    read_sightings,
)
from scene.readers.colmap_records import (
    CAMERA_MODEL_IDS,
    CAMERA_MODEL_NAMES,
    CAMERA_MODELS,
    BaseImage,
    Camera,
    CameraModel,
    Image,
    Point3D,
    qvec2rotmat,
    rotmat2qvec,
)
from scene.readers.colmap_text import read_extrinsics_text, read_intrinsics_text, read_points3D_text

__all__ = [
    "CAMERA_MODELS",
    "CAMERA_MODEL_IDS",
    "CAMERA_MODEL_NAMES",
    "BaseImage",
    "Camera",
    "CameraModel",
    "ColmapModel",
    "ColmapView",
    "Image",
    "Point3D",
    "Sightings",
    "find_model",
    "points_file",
    "qvec2rotmat",
    "read_colmap_bin_array",
    "read_extrinsics_binary",
    "read_extrinsics_text",
    "read_intrinsics_binary",
    "read_intrinsics_text",
    "read_model",
    "read_next_bytes",
    "read_points3D_binary",
    "read_points3D_text",
    "read_sightings",
    "rotmat2qvec",
]
