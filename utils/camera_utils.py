"""The reference's names for functions that make cameras of a dataset's views. Other code may replace them here."""

from scene.cameras import Camera, camera_to_JSON, cameraList_from_camInfos, loadCam

__all__ = ["Camera", "cameraList_from_camInfos", "camera_to_JSON", "loadCam"]
