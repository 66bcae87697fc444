"""convert.py --orient: the vertical of horizons and gravity, and the size and north of GPS."""

import struct
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import ExifTags, Image
from scipy.spatial.transform import Rotation

from applications.convert.georeference import find_level_up
from applications.convert.layout import Layout
from applications.convert.orienting import describe_orientation, orient_scene
from gaussian_renderer.camera_paths.poses import look_along
from groundwork.files.similarity import Similarity, read_orientation
from scene.images.exif import _read_gps, read_place

TILT = Rotation.from_rotvec([0.5, 1.3, -0.4]).as_matrix()  # from the level frame (x east, y down, z north) to the world
UNIT = 0.04  # scene units in a metre
SHIFT = np.array([3.0, -2.0, 5.0])
PLACE = 47.3769, 8.5417, 410.0  # degrees and metres of the ring's middle
COUNT = 12


def ring(rolls=()) -> tuple[np.ndarray, np.ndarray]:
    """Turns (N,3,3) and places (N,3), metres, of cameras that look down at the middle, in the level frame."""
    angles = 2 * np.pi * np.arange(COUNT) / COUNT
    places = 30 * np.stack([np.cos(angles), np.full(COUNT, -0.3), np.sin(angles)], axis=1)
    turns = np.stack([look_along(-place, np.array([0.0, -1, 0])) for place in places])
    for number, roll in enumerate(rolls):
        turns[number] = turns[number] @ Rotation.from_euler("z", roll, degrees=True).as_matrix()
    return turns, places


def flight(pattern: str, size: float, count: int, pitch: float) -> tuple[np.ndarray, np.ndarray]:
    """Turns (N,3,3) and places (N,3), metres, of a flight over a square of that size, as a gimbal holds the camera.

    pattern: of headings. pitch: degrees below the horizon.
    """
    rng, side, number = np.random.default_rng(0), int(np.ceil(np.sqrt(count))), np.arange(count)
    row = number // side
    places = size * np.column_stack([number % side, 0 * row, row]) / max(side - 1, 1)
    places[:, 1] = rng.normal(-60, 1, count)
    places[:, 2] *= pattern != "line"
    headings = {"alternating": 180 * (row % 2), "cross": 90 * (number % 2) + 180 * (row % 2)}.get(pattern, 0 * row)
    headings = 360 * number / count + 180 if pattern == "around" else headings
    if pattern == "around":
        places[:, ::2] = size / 2 * np.stack([np.sin(angle := 2 * np.pi * number / count), np.cos(angle)], axis=1)
    turned = rng.normal(0, (2, 1, 1), (count, 3)) + np.column_stack([headings, np.full(count, -pitch), 0 * row])
    return Rotation.from_euler("YXZ", turned, degrees=True).as_matrix(), places


def gps_of(places: np.ndarray, at: tuple[float, float, float] = PLACE) -> np.ndarray:
    """Latitudes, longitudes and heights (N,3) of places (N,3) in the level frame."""
    earth = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    return earth.enu_to_ellipsoid(places[:, [0, 2, 1]] * [1, 1, -1], *at)


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
        exif[ExifTags.IFD.GPSInfo] = tags | ({5: b"\0", 6: float(gps[2])} if np.isfinite(gps[2]) else {})
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
        pose = " ".join(map(repr, [*wxyz.tolist(), *(-turn.T @ place).tolist()]))
        lines.append(f"{number + 1} {pose} 1 {number}.jpg\n\n")
        options = {} if exifs is None else {"exif": exifs[number]}
        Image.new("RGB", (8, 6)).save(layout.input / f"{number}.jpg", **options)
    (layout.sparse / "0" / "images.txt").write_text("".join(lines))
    return layout


def oriented(layout: Layout) -> tuple[Similarity, dict]:
    orient_scene(layout)
    record = read_orientation(layout.scene)
    return Similarity.read(record, "the record"), record


def test_a_tilted_scene_without_exif_data_becomes_level_in_its_own_unit(tmp_path):
    turns, places = ring(rolls=(88, 90, -91))  # three photos held upright
    similarity, record = oriented(layout := converted(tmp_path, turns, places))
    down = similarity.rotation @ TILT @ [0, 1, 0]
    np.testing.assert_allclose(down, [0, 1, 0], atol=2e-3)
    assert similarity.scale == 1 and record["unit"] == "scene" and "latitude" not in record
    np.testing.assert_allclose(np.median(similarity.transform(UNIT * places @ TILT.T + SHIFT), axis=0), 0, atol=1e-9)
    assert "horizons of 12 photos; no scale" in describe_orientation(layout)[0]


def test_cameras_that_face_one_way_take_their_mean_up():
    turns = np.repeat(look_along(np.array([1.0, 0.3, 0]), np.array([0.0, -1, 0]))[None], 5, axis=0)
    np.testing.assert_allclose(find_level_up(turns), -turns[0][:, 1], atol=1e-6)


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
    moved = similarity.transform(UNIT * places @ TILT.T + SHIFT)
    middle = np.median(places, axis=0)
    np.testing.assert_allclose(moved, places - middle, atol=1.5)
    here = gps_of(middle[None])[0]
    found = similarity.place
    np.testing.assert_allclose(found[:2], here[:2], atol=2e-5)  # degrees, 2 m
    assert found[2] == pytest.approx(here[2], abs=2) and "by GPS of" in describe_orientation(layout)[0]


def _told(gps: np.ndarray, how: str) -> list[np.ndarray | None]:
    """Return GPS positions (N, 3) as photos may state them: in part, without heights, or with an outlier."""
    if how in ("no heights", "one height"):
        gps[:, 2] = np.nan if how == "no heights" else 120.0
    if how == "an outlier":
        gps[3] += [0.002, -0.001, 90]
    return [None if how == "no" or (how == "half" and number % 2) else one for number, one in enumerate(gps)]


FLIGHTS = [  # pattern, size (m), photos, pitch, GPS, its noise (m), place, whether the vertical is known
    ("one way", 300, 64, 60, "all", (3, 3), PLACE, True),
    ("one way", 300, 100, 90, "an outlier", (3, 5), PLACE, True),
    ("one way", 50, 28, 90, "all", (1, 5), PLACE, False),
    ("one way", 300, 64, 90, "no heights", (1, 0), PLACE, False),
    ("one way", 300, 64, 90, "one height", (1, 0), PLACE, False),
    ("alternating", 300, 28, 90, "half", (2, 5), PLACE, True),
    ("alternating", 300, 28, 70, "no heights", (3, 5), PLACE, True),
    ("alternating", 300, 28, 70, "no", (3, 5), PLACE, True),
    ("cross", 50, 28, 90, "one height", (1, 5), PLACE, True),
    ("cross", 300, 28, 90, "all", (3, 5), (89.9995, 10.0, 20.0), True),
    ("cross", 300, 28, 45, "all", (3, 5), (-20.0, 180.0, 20.0), True),
    ("cross", 300, 28, 90, "no", (3, 5), PLACE, False),
    ("around", 100, 40, 30, "half", (1, 5), PLACE, True),
    ("line", 300, 36, 90, "all", (1, 5), PLACE, False),
    ("one way", 300, 3, 90, "all", (1, 5), PLACE, False),
]


@pytest.mark.parametrize(("pattern", "size", "count", "pitch", "how", "noise", "at", "known"), FLIGHTS)
def test_flights_are_level_and_in_metres_or_say_that_they_are_not(
    tmp_path, pattern, size, count, pitch, how, noise, at, known
):
    turns, places = flight(pattern, size, count, pitch)
    told = places + np.random.default_rng(1).normal(size=places.shape) * [noise[0], noise[1], noise[0]]
    exifs = [exif_of(gps) for gps in _told(gps_of(told, at), how)]
    similarity, record = oriented(layout := converted(tmp_path, turns, places, exifs))
    off = np.degrees(np.arccos(min(similarity.rotation[1] @ TILT[:, 1], 1)))
    scaled = similarity.scale * UNIT - 1
    assert (record["vertical"] is not None, similarity.upright) == (known, known)
    assert (off < 1) if known else "not known" in describe_orientation(layout)[0] and not similarity.place
    assert (record["unit"] == "metre") == (how != "no")
    assert how == "no" or abs(scaled) < max(0.01, 2 * record["scale_error"])
    if known and how != "no":
        there = similarity.transform(UNIT * places @ TILT.T + SHIFT)
        earth = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
        east_north = earth.ellipsoid_to_enu(gps_of(places, at), *similarity.place)[:, :2]
        np.testing.assert_allclose(there[:, ::2], east_north, atol=4)


def test_gps_that_tells_no_size_is_left_out(tmp_path):
    turns, places = ring()
    noise = np.random.default_rng(1).normal(scale=20, size=places.shape)
    for name, told, count in (("two photos", places, 2), ("one place", 0 * places, COUNT), ("noise", noise, COUNT)):
        exifs = [exif_of(gps if n < count else None) for n, gps in enumerate(gps_of(told))]
        similarity, record = oriented(converted(tmp_path / name, turns, places, exifs))
        assert similarity.scale == 1 and record["unit"] == "scene", name


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


@pytest.mark.parametrize("spelling", ['{}="{}"', "{}>{}</"])
@pytest.mark.parametrize(("longitude", "pitch", "roll", "down"), [
    ("GpsLongitude", -90, 0, (0, 0, 1)), ("GpsLongtitude", 0, 0, (0, 1, 0)),
    ("GpsLongitude", -30, 90, (0.75**0.5, 0, 0.5)),
])  # fmt: skip
def test_drones_tell_place_and_gravity_in_xmp(tmp_path, spelling, longitude, pitch, roll, down):
    values = {"GpsLatitude": "+47.123456789", longitude: "-8.5", "AbsoluteAltitude": "+512.25",
              "GimbalPitchDegree": f"{pitch:+.2f}", "GimbalRollDegree": f"{roll:+.2f}"}  # fmt: skip
    xmp = " ".join(f"drone-dji:{spelling.format(*one)}" for one in values.items()).encode()
    for orientation, found_down in ((1, down), (6, None)):  # it is not known what the angles are then of
        exif = exif_of(np.array([47.1234, -8.5, 480.0]), orientation=orientation)
        Image.new("RGB", (8, 6)).save(tmp_path / "a.jpg", exif=exif, xmp=xmp)
        found = read_place(tmp_path / "a.jpg")
        assert found.gps == (47.123456789, -8.5, 512.25)
        assert found.down == (found_down and pytest.approx(found_down, abs=1e-12))


@pytest.mark.parametrize(("tags", "place"), [
    ({1: "s", 2: (47.0, 30.0, 36.0), 3: "W ", 4: (8.0, 30.0, 0.0), 5: b"\1", 6: 5.0}, (-47.51, -8.5, -5)),
    ({1: "South", 2: (47.0, 30.6), 3: b"West\0", 4: 8.5, 5: 1, 6: -5.0}, (-47.51, -8.5, -5)),
    ({1: "N", 2: (47.0, 30.6, np.nan), 3: "east", 4: (8.5,), 6: 5.0}, (47.51, 8.5, 5)),  # NaN: of 0/0
    ({2: (-47.0, 30.6), 3: "?", 4: (8.5, np.nan, np.nan), 5: b"\0", 6: np.nan}, (-47.51, 8.5, np.nan)),
    ({1: "\tS\0", 2: (-47.0, 30.6), 3: "E", 4: (8.5,), 6: (5.0,)}, (-47.51, 8.5, 5)),
    ({2: (0.0, -30.6), 4: (8.5,), 6: "5 m"}, (-0.51, 8.5, np.nan)),
    ({2: 47.51, 4: 8.5, 6: np.inf}, (47.51, 8.5, np.nan)),
    ({1: "N", 2: (47.0, np.nan, 36.0), 3: "E", 4: (8.5,)}, None),
    ({1: "N", 2: 47.51, 3: "E", 4: 351.5}, (47.51, -8.5, np.nan)),
    ({1: "N", 2: 47.51, 3: "O", 4: 8.5}, None),  # east of Germans, west of Italians
    ({1: "N", 2: (), 3: "E", 4: (1.0, 2.0, 3.0, 4.0)}, None),
])  # fmt: skip
def test_gps_as_programs_write_it(tags, place):
    found = _read_gps(tags)
    assert found is None if place is None else found == pytest.approx(place, nan_ok=True)
