"""Steps of convert.py by themselves: pairs, smaller copies, points by patches, and what train.py converts first."""

import contextlib
import os
import re
import shutil
import sqlite3
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
import torch
from photo_room import FOCAL, SIZE, cam_to_world, camera_centers, make_photos
from PIL import Image

import convert
import train
from applications.convert import pairing, reduced
from applications.convert.dense_points import find_points
from applications.convert.layout import Layout, find_images, take_photos_beside
from applications.convert.pairing import choose_first_pairs, compute_likeness, name_by_id, plan_rounds, restore_names
from applications.convert.reduced import choose_longest_side, read_enlarged, reduce_photos
from applications.convert.stages import Stage, StageRecord
from arguments import write_cfg_args
from scene.checks.conversion import describe_changed_photos, file_state, is_unfinished
from scene.readers.scene_folder import REPORT, find_capture
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
        alike = compute_likeness(made, [*range(1, PLACES * EACH + 1)])
    nearest = np.argsort(-alike, axis=1)[:, : EACH - 1]
    assert (nearest % PLACES == (np.arange(PLACES * EACH) % PLACES)[:, None]).all()
    nowhere = np.full((PLACES * EACH, 3), np.nan)
    pairs = {pairing.order_pair(*pair) for pair in choose_first_pairs(alike, nowhere)}
    assert {(0, 1), (0, PLACES), (0, 7 * PLACES)} <= pairs
    # Two that neither names nor looks bring together, but GPS does.
    assert (0, 55) not in pairs
    places = nowhere.copy()
    places[[0, 55]] = 0.5
    assert (0, 55) in {pairing.order_pair(*pair) for pair in choose_first_pairs(alike, places)}


def test_gps_tells_who_is_near_beyond_180_degrees_and_at_a_pole():
    world = pycolmap.PosePriorCoordinateSystem.WGS84
    given = [(10.0, 179.9999, 5.0), (10.0, -179.9999, np.nan), (89.9999, 0.0, 0.0), (89.9999, 180.0, 0.0)]
    priors = [
        pycolmap.PosePrior(corr_data_id=pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 1), number),
                           position=np.array(place), coordinate_system=world)
        for number, place in enumerate(given, 1)
    ]  # fmt: skip
    places = pairing.read_gps_places(SimpleNamespace(read_all_pose_priors=lambda: priors), [1, 2, 3, 4])
    away = np.linalg.norm(places[::2] - places[1::2], axis=1)
    assert 20 < away[0] < 25 and 20 < away[1] < 25  # metres


def test_photos_outside_the_largest_group_are_tried_with_all_of_it(database):
    """Each place is a group of its own here, so the photos of all but one are tried with that one's."""
    done: set[tuple[int, int]] = set()
    for pairs in plan_rounds(database, all_of=10):
        assert not pairs & done
        _verify(database, pairs)
        done |= pairs
    largest = pairing.largest_component(pairing.find_bound_pairs(database)).pop() % PLACES
    group = range(largest or PLACES, PLACES * EACH + 1, PLACES)
    assert {pairing.order_pair(one, other) for one in range(1, 81) for other in group if one != other} <= done


def test_names_may_contain_blanks(database):
    def names() -> list[str]:
        with contextlib.closing(sqlite3.connect(database)) as connection:
            return [name for (name,) in connection.execute("SELECT name FROM images ORDER BY image_id")]

    before = names()
    with name_by_id(database):
        assert names() == [str(number) for number in range(1, 81)]
    assert names() == before
    with contextlib.suppress(KeyboardInterrupt), name_by_id(database):
        raise KeyboardInterrupt  # the process ended: nothing restores the names
    assert names() != before
    restore_names(database)
    assert names() == before


@pytest.mark.slow
def test_train_converts_photos_that_have_no_cameras(tmp_path, capsys):
    """They lie in the folder itself. The second training finds the scene."""
    make_photos(tmp_path / "room", 5)
    before = {path.name: path.read_bytes() for path in (tmp_path / "room").iterdir()}
    words = ["-s", str(tmp_path / "room"), "-m", str(tmp_path / "out"), "--iterations", "1", "--quiet", "--no_curve"]
    for first in (True, False):
        train.main([*words, "--test_iterations", "-1"])
        out = capsys.readouterr().out
        assert ("converting what is in it first" in out) == ("5 of 5 photos placed" in out) == first
    assert {path.name: path.read_bytes() for path in (tmp_path / "room").iterdir() if path.is_file()} == before | {
        name: (tmp_path / "room" / name).read_bytes() for name in ("capture.html", "convert_report.json")
    }


def _fill(folder: Path, *names: str, size: int = 0) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for path in (folder / name for name in names):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(bytes(size))


LIVE = [f"{letter}{end}" for letter in "abc" for end in (".HEIC", ".mov")]


@pytest.mark.parametrize(("files", "words"), [
    (["walk.mp4", "data.csv", "depth/0.png", "depth/1.png"], "--video {}/walk.mp4"),  # as StrayScanner has it
    (["cover.jpg", "walk.mp4"], "--video {}/walk.mp4"),
    (["a.jpg", "b.jpg", "c.jpg", "walk.mp4"], ""),
    (["input/walk.mp4", ".a.jpg", "._b.jpg"], "--video {}/input/walk.mp4"),
    (["input/a.png", "b.png"], ""),
    (["input/.DS_Store", "input/._a.jpg", "a.jpg"], ""),
    (["input/without_suffix"], ""),
    (LIVE, ""),
    (["a.ply"], None),
    (["sparse/x", "a.png"], None),
    (["one/sparse/x", "a.png"], None),
    ([".a.jpg"], None),
])  # fmt: skip
def test_what_train_converts(tmp_path, monkeypatch, files, words):
    calls: list[list[str]] = []
    monkeypatch.setattr(convert, "main", calls.append)
    _fill(tmp_path, *files)
    convert.convert_first(str(tmp_path))
    convert.convert_first(str(tmp_path / "missing"))
    assert calls == ([] if words is None else [["-s", str(tmp_path), *words.replace("{}", str(tmp_path)).split()]])
    assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()} == set(files)


def test_the_larger_kind_is_converted(tmp_path):
    for names, size, is_video in (("a.jpg b.jpg c.jpg", 10, False), ("walk.mp4", 31, True), ("d.jpg", 10, False)):
        _fill(tmp_path, *names.split(), size=size)
        assert find_capture(tmp_path).is_video == is_video


def _inputs(scene: Path, is_video: bool = False) -> list[str]:
    layout = Layout(scene)
    take_photos_beside(layout, is_video)
    return find_images(layout, True).photos if not is_video else [layout.input.name]


def test_photos_are_those_that_are_there(tmp_path, capsys):
    """Beside what a conversion made; no copy and no link of an earlier run is asked."""
    make_photos(tmp_path / "room", 5)
    names, scene = [f"photo_0{k}.png" for k in range(5)], tmp_path / "room"
    _fill(scene, ".hidden.jpg", "input/.DS_Store", "capture.html", "orientation.json", "images/x.png", "notes.txt")
    assert _inputs(scene) == names
    (scene / names[0]).unlink()
    (scene / names[1]).rename(scene / "b.png")
    assert _inputs(scene) == ["b.png", *names[2:]]
    assert _inputs(scene, is_video=True) == ["input"]
    assert (
        "not used: b.png, photo_02.png, photo_03.png, photo_04.png (beside the folder input" in capsys.readouterr().out
    )
    for name in names[2:]:
        (scene / name).rename(scene / "input" / name)
    assert _inputs(scene) == names[2:]
    assert capsys.readouterr().out == "not used: b.png (beside the folder input: move them into it)\n"


@pytest.mark.parametrize(("what", "said"), [
    (lambda scene, _: (scene / "input").touch(), "input is a file; remove it, and make a folder of that name"),
    (lambda scene, _: (scene / "input").symlink_to("nowhere"), "input is a link to nothing; remove it, and make"),
    (lambda scene, _: (scene / "0.png").write_bytes(b""), r"0.png is empty; .* or pass --skip_unreadable to"),
    (lambda _, patch: patch.setattr(os, "access", lambda *_: False), "is read-only; copy the photos to a folder of"),
])  # fmt: skip
def test_what_stands_in_the_way_is_named(tmp_path, monkeypatch, what, said):
    make_photos(tmp_path, 3)
    what(tmp_path, monkeypatch)
    with pytest.raises(UserError, match=said):
        train.main(["-s", str(tmp_path), "-m", str(tmp_path / "out")])
    assert not (tmp_path / "distorted").exists()


@pytest.mark.parametrize(("words", "said"), [
    ("-m {}/file/out", "cannot create the folder"),
    ("--start_checkpoint {}/a.pth", "no checkpoint .*a.pth"),
    ("--init_ply {}/a.ply", "no file .*a.ply; give a model"),
    ("--init_ply {}/cloud.ply", "cloud.ply is not a readable PLY"),
    ("--init_pcd_path {}/a.ply", "no point cloud .*a.ply"),
    ("--gpu_memory 4", "--gpu_memory limits the memory of a GPU, and there is none"),
    ("--viewer 70000", "the page's port must be between 0"),
    ("--paused", "--paused needs --viewer"),
    ("--resume", "--resume needs -m"),
    ("-m {}/of_other", "of_other holds a model of another scene"),
])  # fmt: skip
def test_what_a_training_refuses_is_refused_before_a_conversion(tmp_path, monkeypatch, capsys, words, said):
    monkeypatch.setattr(convert, "convert_first", lambda source: pytest.fail("converted"))
    make_photos(scene := tmp_path / "photos", 3)
    (tmp_path / "file").touch()
    (tmp_path / "cloud.ply").write_text("ply\n")
    saved = tmp_path / "of_other" / "point_cloud" / "iteration_7" / "point_cloud.ply"
    saved.parent.mkdir(parents=True)
    saved.touch()
    write_cfg_args(tmp_path / "of_other", SimpleNamespace(source_path=str(tmp_path)))
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(UserError, match=said):
        train.main(["-s", str(scene), "--data_device", "cuda:9", *words.replace("{}", str(tmp_path)).split()])
    assert "--data_device cuda:9 is not available" in capsys.readouterr().err and sorted(tmp_path.rglob("*")) == before


def test_a_failed_conversion_leaves_no_model_folder(tmp_path, monkeypatch):
    def fail(source: str) -> None:
        raise UserError("photos without overlap")

    monkeypatch.setattr(convert, "convert_first", fail)
    make_photos(scene := tmp_path / "photos", 3)
    (tmp_path / "there").mkdir()
    for folder in ("new/out", "there"):
        with pytest.raises(UserError, match="photos without overlap"):
            train.main(["-s", str(scene), "-m", str(tmp_path / folder)])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photos", "there"]


def test_a_folder_that_is_read_only_is_named(tmp_path, monkeypatch):
    make_photos(tmp_path, 3)
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(UserError, match="is read-only; copy the photos to a folder of your own"):
        train.main(["-s", str(tmp_path), "-m", str(tmp_path / "out")])


def test_a_conversion_is_finished_with_its_own_options(tmp_path, monkeypatch):
    calls: list[tuple] = []
    monkeypatch.setattr(convert, "main", lambda words, **options: calls.append((words, options)))
    _fill(tmp_path, "a.jpg", "b.jpg", "c.jpg", "masks/a.png", "distorted/sparse/0/cameras.bin")
    given, plain = {"camera": "OPENCV_FISHEYE", "mask_path": str(tmp_path / "masks")}, ["-s", str(tmp_path)]
    record = StageRecord(tmp_path / "distorted" / "stages.json")
    record.note("options", given)
    record.run([Stage("photos", 1, lambda: None, lambda: None)])
    convert.convert_first(str(tmp_path))
    shutil.rmtree(tmp_path / "masks")
    convert.convert_first(str(tmp_path))
    record.note("options", 5)
    record.run([Stage("photos", 2, lambda: None, lambda: None)])
    convert.convert_first(str(tmp_path))
    record.note("options", {"colmap_executable": "./any"})
    record.run([Stage("photos", 3, lambda: None, lambda: None)])
    with pytest.raises(UserError, match="begun with --colmap_executable; finish it by that command"):
        convert.convert_first(str(tmp_path))
    record.run([Stage("capture", 1, lambda: None, lambda: None)])
    assert calls == [(plain, given), (plain, {}), (plain, {})] and not is_unfinished(tmp_path)


def test_photos_that_change_after_a_conversion_are_named(tmp_path):
    _fill(tmp_path, "a.jpg", "b.jpg", "c.jpg", "capture.html", size=1)
    (tmp_path / REPORT).write_text('{"unused": {"live.CR2": "same name"}}')
    record = StageRecord(tmp_path / "distorted" / "stages.json")
    record.note("files", {name: file_state(tmp_path / name) for name in ("a.jpg", "b.jpg", "c.jpg")})
    record.run([Stage("capture", 1, lambda: None, lambda: None)])
    _fill(tmp_path, "live.CR2")
    assert describe_changed_photos(tmp_path) is None
    shutil.copytree(tmp_path, tmp_path / "copy", copy_function=shutil.copyfile)
    assert describe_changed_photos(tmp_path / "copy") is None
    (tmp_path / "a.jpg").rename(tmp_path / "d.jpg")
    _fill(tmp_path, "b.jpg", size=2)
    said = r": 1 new \(d.jpg\), 1 gone \(a.jpg\), 1 changed \(b.jpg\); .*run convert.py again, with the"
    assert re.search(said, describe_changed_photos(tmp_path))
    _fill(tmp_path, "input/e.jpg")
    assert ": 1 new (e.jpg), 1 gone" in describe_changed_photos(tmp_path)


@pytest.mark.parametrize(("name", "mode"), [
    ("a.jpg", "RGB"), ("b.JPG", "CMYK"), ("c.png", "RGBA"), ("deep/d e.png", "P"), ("f.png", "I;16"), ("g.tif", "L"),
])  # fmt: skip
def test_large_photos_are_made_smaller(tmp_path, name, mode):
    photos, target, exif = tmp_path / "photos", tmp_path / "small", Image.Exif()
    exif[0x0110], exif[0xA405] = "model", 26
    (photos / name).parent.mkdir(parents=True)
    ramp = np.tile(np.linspace(0, 1, 200), (100, 1))
    deep = Image.fromarray((ramp * 65535).astype(np.uint16))
    plain = Image.fromarray((ramp * 255).astype(np.uint8))
    image = deep if mode == "I;16" else plain.convert("RGB").convert(mode)
    image.save(photos / name, **({"exif": exif} if name.lower().endswith("jpg") else {}))
    before = (photos / name).read_bytes()
    reduce_photos(photos, target, [name], 50, None)
    with Image.open(target / name) as small:
        assert small.size == (50, 25)
        if name == "a.jpg":
            assert small.getexif()[0x0110] == "model"
        seen = np.asarray(small.convert("L"), float)
    # The ramp is still one, from dark to bright.
    assert seen[:, :5].mean() < 40 and seen[:, -5:].mean() > 215 and (np.diff(seen.mean(0)) > -8).all()
    assert (photos / name).read_bytes() == before


def test_small_photos_are_linked_and_a_known_size_is_kept(tmp_path):
    (tmp_path / "photos").mkdir()
    Image.new("RGB", (104, 60), "red").save(tmp_path / "photos" / "a.png")
    reduce_photos(tmp_path / "photos", tmp_path / "small", ["a.png"], 100, None)
    assert (tmp_path / "small" / "a.png").samefile(tmp_path / "photos" / "a.png")
    reduce_photos(tmp_path / "photos", tmp_path / "other", ["a.png"], 100, (52, 30))
    assert Image.open(tmp_path / "other" / "a.png").size == (52, 30)
    assert choose_longest_side(reduced.FEW) > choose_longest_side(reduced.FEW + 1)


def test_a_model_is_brought_to_the_size_of_its_photos(tmp_path):
    model, track, point = pycolmap.Reconstruction(), pycolmap.Track(), np.array([0.2, -0.1, 2.0])
    camera = pycolmap.Camera(model="OPENCV", width=100, height=60, params=[90, 91, 50, 30, 0.1, 0, 0, 0], camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    seen = np.asarray(camera.img_from_cam(point))
    for number in (1, 2):
        image = pycolmap.Image(name=f"{number}.png", keypoints=seen.reshape(1, 2), camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
        track.add_element(number, 0)
        Image.new("RGB", (400, 240)).save(tmp_path / f"{number}.png")
    model.add_point3D(point, track, np.zeros(3, np.uint8))
    model.write(str(tmp_path))
    found = read_enlarged(str(tmp_path), tmp_path)
    assert (found.cameras[1].width, found.cameras[1].height) == (400, 240)
    assert found.cameras[1].params == pytest.approx([360, 364, 200, 120, 0.1, 0, 0, 0])
    for image in found.images.values():
        assert image.points2D[0].xy == pytest.approx(4 * seen) == image.project_point(point)


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
    """Photos that share nothing give none."""
    photos: Path = once("six photos of a room", lambda folder: make_photos(folder, VIEWS))
    model, shared = _model(offset)
    points, colors = find_points(model, photos, shared, torch.device("cpu"))
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
    assert [len(found) for found in find_points(model, photos, {}, torch.device("cpu"))] == [0, 0]
