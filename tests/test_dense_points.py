"""Points by patches of photos: on the surfaces that photos show, also far from the origin."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from photo_room import FOCAL, SIZE, cam_to_world, camera_centers, make_photos
from PIL import Image

from splatting.sfm.dense_points import more_points

VIEWS = 6


def _model(offset: np.ndarray) -> tuple[pycolmap.Reconstruction, dict[str, dict[str, int]]]:
    """The cameras of make_photos with a few points on the walls, and which photos share points."""
    model, rng = pycolmap.Reconstruction(), np.random.default_rng(0)
    params = [FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2]
    camera = pycolmap.Camera(model="PINHOLE", width=SIZE[0], height=SIZE[1], params=params, camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    points = rng.uniform(0.1, 1.5, (60, 3))
    points[np.arange(60), np.arange(60) % 3] = 0
    tracks = [pycolmap.Track() for _ in points]
    for number, center in enumerate(camera_centers(VIEWS)):
        turn = cam_to_world(center).T
        seen = np.asarray(camera.img_from_cam((turn @ (points - center).T).T))
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), -turn @ (center + offset))
        image = pycolmap.Image(name=f"photo_{number:02d}.png", keypoints=seen, camera_id=1, image_id=number + 1)
        model.add_image_with_trivial_frame(image, pose)
        for place, track in enumerate(tracks):
            track.add_element(number + 1, place)
    for point, track in zip(points + offset, tracks, strict=True):
        model.add_point3D(point, track, np.zeros(3, np.uint8))
    names = [f"photo_{number:02d}.png" for number in range(VIEWS)]
    return model, {name: {other: 60 for other in names if other != name} for name in names}


@pytest.mark.parametrize("offset", [np.zeros(3), np.array([5e6, -3e5, 200.0])], ids=["near", "far"])
def test_points_lie_on_the_walls(once, offset):
    photos: Path = once("six photos of a room", lambda folder: make_photos(folder, VIEWS))
    model, shared = _model(offset)
    points, colors = more_points(model, photos, shared, torch.device("cpu"))
    # The walls are the planes x = 0, y = 0 and z = 0, some 4 units away, where a pixel is 0.02 units.
    off = np.abs(points - offset).min(axis=1)
    assert len(points) > 500 and colors.shape == points.shape and colors.dtype == np.uint8
    assert np.median(off) < 0.01 and np.percentile(off, 95) < 0.05
    # A point is as bright as a photo is where it shows the point.
    for image in (model.images[1], model.images[VIEWS]):
        pixels = np.asarray(Image.open(photos / image.name))
        x, y = np.array([image.project_point(point) for point in points[::20]]).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < SIZE[0]) & (y < SIZE[1])
        assert np.median(np.abs(pixels[y[inside], x[inside]].astype(float) - colors[::20][inside])) < 15


def test_photos_that_share_nothing_give_no_points(once):
    photos: Path = once("six photos of a room", lambda folder: make_photos(folder, VIEWS))
    points, colors = more_points(_model(np.zeros(3))[0], photos, {}, torch.device("cpu"))
    assert points.shape == colors.shape == (0, 3)
