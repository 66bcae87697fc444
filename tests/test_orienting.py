"""convert.py --orient: the vertical of horizons and gravity, and the size and north of GPS."""

import json
import struct
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import ExifTags, Image
from scipy.spatial.transform import Rotation

from scene.images.place import _down, read_place
from splatting.camera_paths.poses import facing
from splatting.files.similarity import Similarity, read_orientation
from splatting.sfm.layout import Layout
from splatting.sfm.orienting import level_up, orient, said_of
from splatting.sfm.stages import Stage, StageRecord, orient_stage
from utils.system_utils import UserError

TILT = Rotation.from_rotvec([0.5, 1.3, -0.4]).as_matrix()  # from the level frame (x east, y down, z north) to the world
UNIT = 0.04  # scene units in a metre
SHIFT = np.array([3.0, -2.0, 5.0])
PLACE = 47.3769, 8.5417, 410.0  # degrees and metres of the ring's middle
COUNT = 12


def ring(rolls=()) -> tuple[np.ndarray, np.ndarray]:
    """Turns (N,3,3) and places (N,3), metres, of cameras that look down at the middle, in the level frame."""
    angles = 2 * np.pi * np.arange(COUNT) / COUNT
    places = 30 * np.stack([np.cos(angles), np.full(COUNT, -0.3), np.sin(angles)], axis=1)
    turns = np.stack([facing(-place, np.array([0.0, -1, 0])) for place in places])
    for number, roll in enumerate(rolls):
        turns[number] = turns[number] @ Rotation.from_euler("z", roll, degrees=True).as_matrix()
    return turns, places


def gps_of(places: np.ndarray) -> np.ndarray:
    """Latitudes, longitudes and heights (N,3) of places (N,3) in the level frame."""
    earth = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    return earth.enu_to_ellipsoid(places[:, [0, 2, 1]] * [1, 1, -1], *PLACE)


def apple_note(device: np.ndarray) -> bytes:
    """An Apple note with an acceleration (3,) and an entry before it."""
    entries = struct.pack(">HHII", 1, 9, 1, 12) + struct.pack(">HHII", 8, 10, 3, 44)
    values = [number for value in device for number in (round(1e6 * value), 10**6)]
    note = b"Apple iOS\0\0\x01MM" + struct.pack(">H", 2) + entries + struct.pack(">I", 0)
    return note + struct.pack(">6i", *values)


def exif_of(gps: np.ndarray | None, note: bytes | None = None, orientation: int = 1) -> Image.Exif:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    if gps is not None:
        degrees = [(abs(value), 0.0, 0.0) for value in gps[:2]]
        tags = {1: "S" if gps[0] < 0 else "N", 2: degrees[0], 3: "W" if gps[1] < 0 else "E", 4: degrees[1]}
        exif[ExifTags.IFD.GPSInfo] = tags | {5: b"\0", 6: float(gps[2])}
    if note is not None:
        exif[ExifTags.IFD.Exif] = {ExifTags.Base.MakerNote: note}
    return exif


def converted(folder: Path, turns: np.ndarray, places: np.ndarray, exifs=None) -> Layout:
    """A converted scene in a tilted world of another unit, whose photos have EXIF data."""
    layout = Layout(folder)
    (layout.sparse / "0").mkdir(parents=True)
    layout.input.mkdir()
    (layout.sparse / "0" / "cameras.txt").write_text("1 PINHOLE 8 6 8 8 4 3\n")
    lines = []
    for number, (turn, place) in enumerate(zip(TILT @ turns, UNIT * places @ TILT.T + SHIFT, strict=True)):
        wxyz = Rotation.from_matrix(turn.T).as_quat(scalar_first=True)
        lines.append(
            " ".join(map(repr, [number + 1, *wxyz.tolist(), *(-turn.T @ place).tolist()])) + f" 1 {number}.jpg\n\n"
        )
        options = {} if exifs is None else {"exif": exifs[number]}
        Image.new("RGB", (8, 6)).save(layout.input / f"{number}.jpg", **options)
    (layout.sparse / "0" / "images.txt").write_text("".join(lines))
    return layout


def oriented(layout: Layout) -> tuple[Similarity, dict]:
    orient(layout)
    record = read_orientation(layout.scene)
    return Similarity.of(record, "the record"), record


def test_a_tilted_scene_without_exif_data_becomes_level_in_its_own_unit(tmp_path):
    turns, places = ring(rolls=(88, 90, -91))  # three photos held upright
    similarity, record = oriented(layout := converted(tmp_path, turns, places))
    down = similarity.rotation @ TILT @ [0, 1, 0]
    np.testing.assert_allclose(down, [0, 1, 0], atol=2e-3)
    assert similarity.scale == 1 and record["unit"] == "scene" and "latitude" not in record
    np.testing.assert_allclose(np.median(similarity.points(UNIT * places @ TILT.T + SHIFT), axis=0), 0, atol=1e-9)
    assert "horizons of 12 photos; no scale" in said_of(layout)[0]


def test_cameras_that_face_one_way_take_their_mean_up():
    turns = np.repeat(facing(np.array([1.0, 0.3, 0]), np.array([0.0, -1, 0]))[None], 5, axis=0)
    np.testing.assert_allclose(level_up(turns), -turns[0][:, 1], atol=1e-6)


@pytest.mark.parametrize("lost", [0, 3])
def test_gps_gives_metres_and_north(tmp_path, lost):
    """lost: photos whose places are wrong by 200 m."""
    turns, places = ring()
    noise = np.random.default_rng(0).normal(scale=1.0, size=places.shape)
    noise[:lost, 0] += 200
    layout = converted(tmp_path, turns, places, [exif_of(gps) for gps in gps_of(places + noise)])
    similarity, record = oriented(layout)
    assert record["unit"] == "metre" and record["gps_photos"] == COUNT - lost
    assert similarity.scale * UNIT == pytest.approx(1, rel=0.02)  # 1 m / (30 m * sqrt(9)), twice
    np.testing.assert_allclose(similarity.rotation @ TILT, np.eye(3), atol=0.03)
    moved = similarity.points(UNIT * places @ TILT.T + SHIFT)
    middle = np.median(places, axis=0)
    np.testing.assert_allclose(moved, places - middle, atol=1.5)
    here = gps_of(middle[None])[0]
    found = similarity.place
    np.testing.assert_allclose(found[:2], here[:2], atol=2e-5)  # degrees, 2 m
    assert found[2] == pytest.approx(here[2], abs=2) and "m by GPS" in said_of(layout)[0]


@pytest.mark.parametrize("case", ["two photos", "one place", "noise"])
def test_gps_that_tells_no_size_is_left_out(tmp_path, case):
    turns, places = ring()
    rng = np.random.default_rng(1)
    told = {"two photos": places, "one place": 0 * places, "noise": rng.normal(scale=20, size=places.shape)}[case]
    exifs = [exif_of(gps if case != "two photos" or n < 2 else None) for n, gps in enumerate(gps_of(told))]
    similarity, record = oriented(converted(tmp_path, turns, places, exifs))
    assert similarity.scale == 1 and record["unit"] == "scene"


@pytest.mark.parametrize("orientation", [1, 6, 3, 8])
def test_gravity_of_a_phone_comes_before_horizons(tmp_path, orientation):
    """Every photo leans to the same side, which horizons of a ring do not show as a lean of the world."""
    turns, places = ring(rolls=(20,) * 5)
    turned = {1: 0, 6: 90, 3: 180, 8: 270}[orientation]  # degrees clockwise, from stored to upright
    exifs = []
    for turn in turns:
        down = turn.T @ [0, 1, 0]
        right, low, _ = Rotation.from_euler("z", -turned, degrees=True).apply(down)
        exifs.append(exif_of(None, apple_note(np.array([-low, -right, -down[2]])), orientation))
    layout = converted(tmp_path, turns, places, exifs)
    np.testing.assert_allclose(read_place(layout.input / "0.jpg").down, turns[0].T @ [0, 1, 0], atol=1e-5)
    similarity, record = oriented(layout)
    np.testing.assert_allclose(similarity.rotation @ TILT @ [0, 1, 0], [0, 1, 0], atol=1e-5)
    assert record["vertical"] == "gravity of 12 photos"


def test_an_upright_phone_tells_down():
    """Held upright, iOS says (0, -1, 0), and stores the photo with orientation 6."""
    np.testing.assert_allclose(_down(apple_note(np.array([0.0, -1, 0])), 6), [0, 1, 0], atol=1e-6)
    assert _down(apple_note(np.array([0.0, -3, 0])), 6) is None and _down(b"Apple iOS\0\0\x01MM\0\x09", 6) is None


def test_a_model_that_is_made_again_loses_its_orientation(tmp_path):
    layout = converted(tmp_path, *ring())
    layout.work.mkdir()
    record, before = StageRecord(layout.stages), Stage("before", 1, lambda: None, lambda: None)
    record.run([before, orient_stage(layout)])
    assert record.run([before, orient_stage(layout)]) == ["before", "orient"] and layout.orientation.is_file()
    with pytest.raises(ZeroDivisionError):
        record.run([before._replace(made_from=2, work=lambda: 1 / 0), orient_stage(layout)])
    assert not layout.orientation.exists()


@pytest.mark.parametrize("change", [{"scale": -1}, {"rotation": [[1]]}, {"translation": [0, 0, None]}])
def test_a_damaged_record_is_refused(tmp_path, change):
    layout = converted(tmp_path, *ring())
    _, record = oriented(layout)
    layout.orientation.write_text(json.dumps(record | change))
    with pytest.raises(UserError, match=r"orientation\.json has no rotation"):
        read_orientation(tmp_path)
