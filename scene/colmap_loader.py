"""The reference's name for the reader of COLMAP models, which is scene/readers/colmap_model.py."""

from scene.readers.colmap_model import (
    ColmapModel,
    ColmapView,
    Sightings,
    find_model,
    points_file,
    read_model,
    read_sightings,
)

__all__ = ["ColmapModel", "ColmapView", "Sightings", "find_model", "points_file", "read_model", "read_sightings"]
