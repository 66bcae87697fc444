"""Names that users of the reference import from here; the code lives with the cameras."""

from scene.cameras import camera_to_JSON, cameraList_from_camInfos

__all__ = ["cameraList_from_camInfos", "camera_to_JSON"]
