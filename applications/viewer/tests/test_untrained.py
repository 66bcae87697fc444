"""A scene before its training: points as Gaussians, and cameras that have their photos."""

import argparse

import numpy as np

from applications.viewer.untrained import load_untrained
from arguments import ModelParams


def test_points_are_gaussians_of_their_places_and_cameras_have_photos(colmap_scene):
    parser = argparse.ArgumentParser()
    params = ModelParams(parser, sentinel=True)
    scene = load_untrained(params.extract(parser.parse_args(["-s", str(colmap_scene)])))
    points = scene.info.point_cloud.points
    assert np.allclose(scene.gaussians.get_xyz.detach().cpu().numpy(), points, atol=1e-5)
    assert float(scene.gaussians.get_scaling.max()) < 0.01 * scene.cameras_extent
    assert scene.getTrainCameras()[0].target((0.0, 0.0, 0.0)).float().std() > 0
