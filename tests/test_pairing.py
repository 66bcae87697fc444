"""Which pairs of photos convert.py matches, and photos that train.py converts before it trains on them."""

import contextlib
import sqlite3
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from photo_room import make_photos

import convert
import train
from splatting.sfm import pairing
from splatting.sfm.pairing import first_pairs, likeness, named_by_id, restore_names, rounds
from utils.system_utils import UserError

PLACES, EACH = 10, 8  # photos of the same place look alike


@pytest.fixture
def database(tmp_path) -> str:
    """Photos that show PLACES by turns, so that those of one place are no neighbours by name."""
    path, rng = str(tmp_path / "database.db"), np.random.default_rng(0)
    looks = rng.integers(0, 200, (PLACES, 60, 128))
    with contextlib.closing(pycolmap.Database.open(path)) as made:
        camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 700.0, 800, 600)
        made.write_camera(camera, use_camera_id=True)
        for number in range(PLACES * EACH):
            image = pycolmap.Image(name=f"Ünser Bild {number:03d}.jpg", camera_id=1)
            made.write_image(image)
            seen = looks[number % PLACES] + rng.integers(0, 20, (60, 128))
            descriptors = pycolmap.FeatureDescriptors(
                data=seen.astype(np.uint8), type=pycolmap.FeatureExtractorType.SIFT
            )
            made.write_descriptors(number + 1, descriptors)
            made.write_keypoints(number + 1, rng.uniform(0, 600, (60, 2)).astype(np.float32))
    return path


def _verify(path: str, pairs: set[tuple[int, int]]) -> None:
    """Write verified matches of those pairs whose photos show the same place."""
    with contextlib.closing(pycolmap.Database.open(path)) as made:
        for one, other in pairs:
            if (one - other) % PLACES == 0:
                geometry = pycolmap.TwoViewGeometry()
                geometry.config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
                geometry.inlier_matches = np.zeros((40, 2), np.uint32)
                made.write_two_view_geometry(one, other, geometry)


def test_photos_that_look_alike_are_found(database):
    with contextlib.closing(pycolmap.Database.open(database)) as made:
        alike = likeness(made, [*range(1, PLACES * EACH + 1)])
    nearest = np.argsort(-alike, axis=1)[:, : EACH - 1]
    assert (nearest % PLACES == (np.arange(PLACES * EACH) % PLACES)[:, None]).all()
    nowhere = np.full((PLACES * EACH, 3), np.nan)
    pairs = {pairing.ordered(*pair) for pair in first_pairs(alike, nowhere)}
    assert {(0, 1), (0, PLACES), (0, 7 * PLACES)} <= pairs
    # Two that neither names nor looks bring together, but GPS does.
    assert (0, 55) not in pairs
    places = nowhere.copy()
    places[[0, 55]] = 0.5
    assert (0, 55) in {pairing.ordered(*pair) for pair in first_pairs(alike, places)}


def test_gps_tells_who_is_near_beyond_180_degrees_and_at_a_pole():
    world = pycolmap.PosePriorCoordinateSystem.WGS84
    given = [(10.0, 179.9999, 5.0), (10.0, -179.9999, np.nan), (89.9999, 0.0, 0.0), (89.9999, 180.0, 0.0)]
    priors = [
        pycolmap.PosePrior(corr_data_id=pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 1), number),
                           position=np.array(place), coordinate_system=world)
        for number, place in enumerate(given, 1)
    ]  # fmt: skip
    places = pairing.gps_places(SimpleNamespace(read_all_pose_priors=lambda: priors), [1, 2, 3, 4])
    away = np.linalg.norm(places[::2] - places[1::2], axis=1)
    assert 20 < away[0] < 25 and 20 < away[1] < 25  # metres


def test_few_photos_are_all_matched(database):
    (pairs,) = rounds(database, all_of=100)
    assert len(pairs) == 80 * 79 // 2 and all(one < other for one, other in pairs)


def test_photos_outside_the_largest_group_are_tried_with_all_of_it(database):
    """Each place is a group of its own here, so the photos of all but one are tried with that one's."""
    done: set[tuple[int, int]] = set()
    found = rounds(database, all_of=10)
    for pairs in found:
        assert not pairs & done
        _verify(database, pairs)
        done |= pairs
    group = {
        number
        for number in range(1, 81)
        if number % PLACES == pairing.joined(pairing.bound_pairs(database)).pop() % PLACES
    }
    assert {pairing.ordered(one, other) for one in range(1, 81) for other in group if one != other} <= done


def test_the_number_of_pairs_is_bound(database, monkeypatch):
    monkeypatch.setattr(pairing, "_MOST", 1)
    first, *more = rounds(database, all_of=10)
    assert sum(map(len, more)) <= 80


def test_names_may_contain_blanks(database):
    def names() -> list[str]:
        with contextlib.closing(sqlite3.connect(database)) as connection:
            return [name for (name,) in connection.execute("SELECT name FROM images ORDER BY image_id")]

    before = names()
    with named_by_id(database):
        assert names() == [str(number) for number in range(1, 81)]
    assert names() == before
    with contextlib.suppress(KeyboardInterrupt), named_by_id(database):
        raise KeyboardInterrupt  # the process ended: nothing restores the names
    assert names() != before
    restore_names(database)
    assert names() == before


@pytest.mark.slow
def test_train_converts_photos_that_have_no_cameras(tmp_path, capsys):
    """They lie in the folder itself. The second training finds the scene."""
    make_photos(tmp_path / "room", 8)
    before = {path.name: path.read_bytes() for path in (tmp_path / "room").iterdir()}
    words = ["-s", str(tmp_path / "room"), "-m", str(tmp_path / "out"), "--iterations", "1", "--quiet", "--no_curve"]
    for first in (True, False):
        train.main([*words, "--test_iterations", "-1"])
        out = capsys.readouterr().out
        assert ("converting what is in it first" in out) == ("8 of 8 photos placed" in out) == first
    assert {path.name: path.read_bytes() for path in (tmp_path / "room").iterdir() if path.is_file()} == before | {
        name: (tmp_path / "room" / name).read_bytes() for name in ("capture.html", "convert_report.json")
    }
    assert (tmp_path / "out" / "point_cloud" / "iteration_1" / "point_cloud.ply").is_file()


def test_what_train_converts(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(convert, "main", calls.append)
    made = {"video": ["walk.mp4"], "photos": ["input/a.png", "b.png"], "none": ["a.ply"]}
    made |= {"scene": ["sparse/x", "a.png"], "above": ["one/sparse/x", "a.png"], "live": ["a.HEIC", "a.mov"]}
    for name, files in made.items():
        for file in files:
            (tmp_path / name / file).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name / file).touch()
        (tmp_path / name).mkdir(exist_ok=True)
        convert.convert_first(str(tmp_path / name))
    convert.convert_first(str(tmp_path / "missing"))
    video, photos, live = (str(tmp_path / name) for name in ("video", "photos", "live"))
    assert calls == [["-s", video, "--video", f"{video}/walk.mp4"], ["-s", photos], ["-s", live]]
    assert [path.name for path in (tmp_path / "photos" / "input").iterdir()] == ["a.png"]  # b was not put there
    assert not (tmp_path / "above" / "input").exists()
    # Photos that come later, where the first ones were.
    (tmp_path / "live" / "b.HEIC").touch()
    convert.convert_first(live)
    assert sorted(path.name for path in (tmp_path / "live" / "input").iterdir()) == ["a.HEIC", "b.HEIC"]
    with pytest.raises(UserError, match="is not a scene"):
        train.main(["-s", str(tmp_path / "none"), "-m", str(tmp_path / "out")])
