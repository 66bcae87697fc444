"""COLMAP model of the demo's cameras and points, written by pycolmap."""

from __future__ import annotations

from pathlib import Path

from PIL import Image  # noqa: F401  before pycolmap: unless Pillow's zlib is loaded first, writing PNGs aborts

from demo.surface_points import SurfacePoints
from demo.tracer import View


def write_model(folder: Path, names: list[str], views: list[View], points: SurfacePoints) -> None:
    """Make `folder` with a binary COLMAP model: one PINHOLE camera, an image per view, points with their tracks."""
    import pycolmap

    first = views[0]
    model = pycolmap.Reconstruction()
    params = [first.focal, first.focal, first.width / 2, first.height / 2]
    camera = pycolmap.Camera(model="PINHOLE", width=first.width, height=first.height, params=params, camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    tracks = [pycolmap.Track() for _ in points.xyz]
    for image_id, (name, view) in enumerate(zip(names, views, strict=True), 1):
        image = pycolmap.Image(name=name, keypoints=points.keypoints[image_id - 1], camera_id=1, image_id=image_id)
        translation = -view.rotation @ view.center
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(view.rotation), translation))
        for place, index in enumerate(points.seen[image_id - 1]):
            tracks[index].add_element(image_id, place)
    for xyz, track, rgb in zip(points.xyz, tracks, points.rgb, strict=True):
        model.add_point3D(xyz, track, rgb)
    model.update_point_3d_errors()
    folder.mkdir(parents=True)
    model.write_binary(folder)
