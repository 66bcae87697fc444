"""Scale, upright and front of a scene from points that somebody has clicked."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundwork.files.measured import measured_record
from groundwork.files.similarity import Similarity
from utils.system_utils import UserError

TURN = Rotation.from_euler("xyz", [0.3, 0.5, -0.7]).as_matrix()  # from a frame whose y is down to the scene's world
SCALE, SHIFT = 0.25, np.array([3.0, -2.0, 5.0])  # a metre in the scene's unit
GROUND = np.array([[0.0, 0, 0], [4, 0, 1], [-1, 0, 3]])  # metres
GPS = {
    "unit": "metre",
    "gps_photos": 9,
    "gps_error": 1.0,
    "scale_error": 0.1,
    "vertical": "gravity",
    "vertical_error": 2.0,
    "latitude": 1.0,
    "longitude": 2.0,
    "height": 3.0,
    "scale": 5.0,
    "rotation": np.eye(3).tolist(),
    "translation": [1.0, 2.0, 3.0],
}


def scene(points) -> np.ndarray:
    """Points of the scene, of those in metres."""
    return SCALE * np.asarray(points, float) @ TURN.T + SHIFT


ABOVE = scene([1.0, -2.0, 0.0])


def test_points_tell_where_a_scene_stands_in_metres():
    front = scene([[1.0, 0.3, 1.0], [3.0, -0.4, 1.0]])  # along x, and not quite level
    for ground in (GROUND, GROUND[::-1]):  # in any order
        record = measured_record(None, ABOVE, 1 / SCALE, scene(ground), front)
        found = Similarity.read(record, "here")
        assert found.upright and found.metric and not found.place
        np.testing.assert_allclose(found.transform(scene(GROUND)), GROUND - GROUND.mean(0), atol=1e-9)
    turned = measured_record(None, ABOVE, None, scene(GROUND), front[::-1])  # from the other side
    np.testing.assert_allclose(turned["rotation"][0], -np.array(record["rotation"][0]), atol=1e-9)
    assert turned["scale"] == 1.0 and turned["unit"] == "scene"


def test_what_is_not_measured_stays():
    scaled = measured_record(GPS, ABOVE, 2.0)
    origin = -np.array(GPS["translation"]) / GPS["scale"]
    np.testing.assert_allclose(Similarity.read(scaled, "here").transform(origin[None]), 0, atol=1e-9)
    assert scaled["latitude"] == 1.0 and "gps_photos" not in scaled and scaled["vertical"] == "gravity"
    level = measured_record(GPS, np.array([0, -1.0, 0]), None, np.array([[0, 0, 0], [1, 0.1, 0], [0, 0, 1.0]]))
    assert "latitude" not in level and level["scale"] == 5.0 and level["gps_photos"] == 9
    assert level["vertical"] == "three points of the ground" and "vertical_error" not in level
    rotation = np.array(level["rotation"])
    assert np.trace(rotation) > 2.98 and rotation[2] == pytest.approx([0, 0, 1])  # turned no more than it must be
    only = measured_record(None, ABOVE, 2.0)
    assert not Similarity.read(only, "here").upright and only["unit"] == "metre"


@pytest.mark.parametrize(
    ("points", "fault"),
    [
        ({"front": np.eye(3)[:2]}, "what is up; click three points of the ground"),
        ({"ground": np.outer([0, 1, 2], [1, 1, 1.0])}, "lie on a line"),
        ({"ground": np.zeros((3, 3))}, "lie on a line"),
        ({"ground": GROUND * np.nan}, "lie on a line"),
        ({"ground": scene(GROUND), "front": scene([[0, 0, 0], [0, -3.0, 0]])}, "straight up"),
    ],
)
def test_points_that_tell_nothing_are_refused(points, fault):
    with pytest.raises(UserError, match=fault):
        measured_record(None, ABOVE, **points)
