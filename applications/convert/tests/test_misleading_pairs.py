"""Pairs that agree with a wrong model: a camera that only turns, and parts of a scene that look alike."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from applications.convert.checks import is_folded, is_only_turned, is_wrong
from scene.rotation_only import rotation_error
from scene.unmatched import find_cover, find_overlaps

WIDTH, HEIGHT, FOCAL = 400, 300, 240.0
HALF = np.array([2.5, 1.25, 2.0])  # of a room, in units
JUDGED = {"pairs": 90, "contradicting": 0.0, "agreeing": 20, "photos": 20, "bound": 20}


def _walls(count: int, seed: int) -> np.ndarray:
    """Points (count, 3) on the walls of a room around the origin."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3))
    axis = rng.integers(0, 3, count)
    points[np.arange(count), axis] = np.sign(points[np.arange(count), axis])
    return points * HALF


def _wall(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (count, 3)) * [6, 1.5, 0.0] + [0, 0, 2]


Pose = tuple[np.ndarray, np.ndarray]  # a camera's place (3,) and its turn from the world (3, 3)


def _turning(noise: float) -> list[Pose]:
    rng = np.random.default_rng(0)
    return [
        (
            noise * rng.standard_normal(3),
            Rotation.from_euler("yx", [20 * k, rng.uniform(-5, 5)], degrees=True).as_matrix(),
        )
        for k in range(18)
    ]


def _walking() -> list[Pose]:
    """Cameras that walk along a wall and look at it."""
    rng = np.random.default_rng(0)
    return [
        (np.array([0.4 * k - 3, rng.normal() * 0.05, 0]), Rotation.from_rotvec(0.05 * rng.normal(size=3)).as_matrix())
        for k in range(16)
    ]


def _facing(count: int) -> list[Pose]:
    """Cameras in an arc that look at one wall of a room."""
    return [
        (
            np.array([3.2 * k / count - 1.6, 0, -1.0]),
            Rotation.from_euler("y", 30 - 60 * k / count, degrees=True).as_matrix(),
        )
        for k in range(count)
    ]


def _write(
    path: Path, poses: list[Pose], seen: Callable[[int], np.ndarray], points: np.ndarray
) -> pycolmap.Reconstruction:
    """Write a database in which photos share the points (N, 3) that both see, and return the model of it.

    seen: by number of a photo the rows that it may show.
    """
    rng, model = np.random.default_rng(1), pycolmap.Reconstruction()
    database = pycolmap.Database.open(str(path))
    camera = pycolmap.Camera(
        model="PINHOLE", width=WIDTH, height=HEIGHT, params=[FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2], camera_id=1
    )
    model.add_camera_with_trivial_rig(camera)
    database.write_camera(camera, use_camera_id=True)
    database.write_rig(model.rigs[1], use_rig_id=True)
    rows, tracks = {}, [pycolmap.Track() for _ in points]
    for number, (place, turn) in enumerate(poses, 1):
        possible = seen(number - 1)
        pixels = np.asarray(camera.img_from_cam((points[possible] - place) @ turn.T))
        with np.errstate(invalid="ignore"):
            inside = ((pixels > 0) & (pixels < [WIDTH, HEIGHT])).all(1)
        rows[number] = possible[inside]
        pixels = (pixels[inside] + 0.2 * rng.standard_normal((inside.sum(), 2))).astype(np.float32)
        image = pycolmap.Image(name=f"{number - 1:02d}.jpg", keypoints=pixels, camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(turn), -(turn @ place)))
        database.write_frame(model.frames[number], use_frame_id=True)
        database.write_image(image, use_image_id=True)
        database.write_keypoints(number, pixels)
        for at, row in enumerate(rows[number]):
            tracks[row].add_element(number, at)
    for one in rows:
        for other in range(one + 1, len(poses) + 1):
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            _, *both = np.intersect1d(rows[one], rows[other], return_indices=True)
            geometry.inlier_matches = np.stack(both, 1).astype(np.uint32)
            database.write_two_view_geometry(one, other, geometry)
    database.close()
    for point, track in zip(points, tracks, strict=True):
        if track.length() > 1:
            model.add_point3D(point, track, np.zeros(3, np.uint8))
    return model


@pytest.mark.parametrize(
    ("poses", "points", "turned"),
    [
        (_turning(0.0), _walls(4000, 0), True),
        (_turning(0.03), _walls(4000, 0), True),
        (_turning(0.3), _walls(4000, 0), False),
        (_walking(), _wall(4000, 0), False),
    ],
    ids=["in one place", "3 cm of noise", "30 cm of noise", "along a flat wall"],
)
def test_a_camera_that_only_turns_is_told_from_one_that_moves(tmp_path, poses, points, turned):
    path = tmp_path / "database.db"
    _write(path, poses, lambda _: np.arange(len(points)), points)
    found = JUDGED | {"rotation": rotation_error(str(path))}
    assert is_only_turned(found) == is_wrong(found) == turned


def _unmatched(model: pycolmap.Reconstruction, path: Path) -> list[str]:
    return find_cover([pair[:2] for pair in find_overlaps(model, str(path)) if pair.is_unmatched])


def test_rooms_with_one_poster_are_not_the_same_room(tmp_path):
    """Both lie on each other, and all matches agree; a room alone, of whose features others find a half, is right."""
    poster = np.random.default_rng(2).uniform(-1, 1, (300, 3)) * [0.6, 0.6, 0] + [0, 0, HALF[2]]
    points = np.concatenate([poster, _walls(4000, 0), _walls(4000, 1)])
    numbers, draws = np.arange(len(points)), np.random.default_rng(3)

    def seen(photo: int, rooms: int) -> np.ndarray:
        wall = 1 + photo % rooms
        rows = np.concatenate([numbers[:300], numbers[300 + 4000 * (wall - 1) : 300 + 4000 * wall]])
        return rows[draws.random(len(rows)) < 0.5]

    for rooms in (1, 2):
        path = tmp_path / f"{rooms}.db"
        alike = _unmatched(_write(path, _facing(20), lambda photo, rooms=rooms: seen(photo, rooms), points), path)
        found = JUDGED | {"alike": alike, "rotation": rotation_error(str(path))}
        assert is_folded(found) == is_wrong(found) == (rooms == 2)
        assert len(alike) >= 8 * (rooms - 1)
