"""The points that views of all kinds of lenses see, by pycolmap's poses."""

import numpy as np
import pytest
import torch
from synthetic import FOCAL, make_colmap_scene, options_of

from scene import GaussianModel, Scene
from scene.in_view import is_in_view, share_in_view


@pytest.mark.parametrize(
    ("model", "distortion"), [("PINHOLE", ()), ("OPENCV", (-0.1, 0.01, 0.0, 0.0)), ("OPENCV_FISHEYE", (0.01, 0, 0, 0))]
)
def test_points_that_a_view_sees(tmp_path, model, distortion):
    known = make_colmap_scene(tmp_path / "scene", model=model, params=(FOCAL, FOCAL, 48.0, 32.0, *distortion), views=6)
    scene = Scene(options_of(tmp_path / "scene", tmp_path / "out", lenses="native"), GaussianModel(0), shuffle=False)
    points, views = np.random.default_rng(0).uniform(-4, 4, (300, 3)), scene.getTrainCameras()
    images, share = {image.name: image for image in known.images.values()}, 0.0
    for view in views:
        seen = np.array([images[view.image_name].cam_from_world() * point for point in points])
        across, down = FOCAL * seen[:, :2].T / seen[:, 2]
        shown = (np.abs(across) < 48) & (np.abs(down) < 32)
        if "FISHEYE" in model:
            shown = np.arccos(seen[:, 2] / np.linalg.norm(seen, axis=1)) < view.lens.field(96, 64)
        shown &= seen[:, 2] > 0.2
        assert (is_in_view(torch.from_numpy(points).float(), view).numpy() == shown).all()
        share += shown.mean() / len(views)
    assert 0 < share < 1 and share_in_view(torch.from_numpy(points).float(), views) == pytest.approx(share)
