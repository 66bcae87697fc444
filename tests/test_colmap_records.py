"""Single files of a COLMAP model against pycolmap, for all of its camera models, and what is said of broken files."""

import importlib.util
import io
import shutil
import struct
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from scene import colmap_loader as loader
from scene.images import lens
from scene.readers.colmap import ColmapModel, read_model
from utils.system_utils import UserError

MODELS = [model for model in pycolmap.CameraModelId.__members__.values() if int(model) >= 0]
READERS = {
    "cameras": (loader.read_intrinsics_binary, loader.read_intrinsics_text),
    "images": (loader.read_extrinsics_binary, loader.read_extrinsics_text),
    "points3D": (loader.read_points3D_binary, loader.read_points3D_text),
}


@pytest.fixture(scope="module")
def model() -> pycolmap.Reconstruction:
    """A camera of each model, each with a photo of 0 to 3 2D points, whose name has a space; and some points."""
    rng = np.random.default_rng(0)
    model = pycolmap.Reconstruction()
    for number, kind in enumerate(MODELS, start=3):
        camera = pycolmap.Camera.create_from_model_id(number, kind, 500.0, 640 + number, 480)
        camera.params = rng.normal(size=len(camera.params))
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=f"a folder/Straße {number}.png", camera_id=number, image_id=200 - number)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in rng.uniform(0, 480, (number % 4, 2))])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(Rotation.random(random_state=number).as_quat()), rng.normal(size=3))
        model.add_image_with_trivial_frame(image, pose)
    photos = [image_id for image_id in model.images if len(model.images[image_id].points2D)]
    for number in range(40):
        track = pycolmap.Track()
        if number == 0:
            for image_id in photos:
                track.add_element(image_id, 0)
        point_id = model.add_point3D(rng.normal(size=3), track, rng.integers(0, 256, 3).astype(np.uint8))
        model.points3D[point_id].error = rng.uniform()
    return model


@pytest.fixture(scope="module")
def folder(model: pycolmap.Reconstruction, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The model in both kinds of files."""
    folder = tmp_path_factory.mktemp("model")
    model.write_binary(str(folder))
    model.write_text(str(folder))
    return folder


def test_the_table_has_every_camera_model_of_pycolmap():
    wanted = {
        int(kind): (kind.name, len(pycolmap.Camera.create_from_model_id(1, kind, 9.0, 8, 6).params)) for kind in MODELS
    }
    assert {model.model_id: (model.model_name, model.num_params) for model in loader.CAMERA_MODELS} == wanted
    assert {number: (model.model_name, model.num_params) for number, model in loader.CAMERA_MODEL_IDS.items()} == wanted
    assert loader.CAMERA_MODEL_NAMES["PINHOLE"] == (1, "PINHOLE", 4) == loader.CameraModel(1, "PINHOLE", 4)


@pytest.mark.parametrize("suffix", ["bin", "txt"])
def test_cameras_are_those_of_pycolmap(model, folder, suffix):
    cameras = READERS["cameras"][suffix == "txt"](str(folder / f"cameras.{suffix}"))
    assert set(cameras) == set(model.cameras) and len(cameras) == len(MODELS)
    for camera_id, wanted in model.cameras.items():
        camera = cameras[camera_id]
        assert camera[:4] == (camera_id, wanted.model_name, wanted.width, wanted.height)
        assert camera._fields == ("id", "model", "width", "height", "params") and camera.params.dtype == np.float64
        np.testing.assert_array_equal(camera.params, wanted.params)


@pytest.mark.parametrize("suffix", ["bin", "txt"])
def test_photos_are_those_of_pycolmap(model, folder, suffix):
    images = READERS["images"][suffix == "txt"](folder / f"images.{suffix}")
    assert set(images) == set(model.images)
    for image_id, wanted in model.images.items():
        image, pose = images[image_id], wanted.cam_from_world()
        assert image._fields == ("id", "qvec", "tvec", "camera_id", "name", "xys", "point3D_ids")
        assert (image.id, image.camera_id, image.name) == (image_id, wanted.camera_id, wanted.name)
        np.testing.assert_array_equal(image.tvec, pose.translation)
        np.testing.assert_allclose(image.qvec, pose.rotation.quat[[3, 0, 1, 2]], atol=1e-15)
        np.testing.assert_allclose(image.qvec2rotmat(), pose.rotation.matrix(), atol=1e-14)
        np.testing.assert_array_equal(image.xys, np.array([p.xy for p in wanted.points2D]).reshape(-1, 2))
        ids = [point.point3D_id if point.has_point3D() else -1 for point in wanted.points2D]
        np.testing.assert_array_equal(image.point3D_ids, ids)
        assert image.xys.shape == (len(ids), 2) and image.point3D_ids.dtype == np.int64
    assert any(image.point3D_ids.max(initial=-1) > 0 for image in images.values())


@pytest.mark.parametrize("suffix", ["bin", "txt"])
def test_points_are_those_of_pycolmap(model, folder, suffix):
    xyzs, rgbs, errors = READERS["points3D"][suffix == "txt"](folder / f"points3D.{suffix}")
    assert xyzs.shape == rgbs.shape == (40, 3) and errors.shape == (40, 1)
    assert {part.dtype for part in (xyzs, rgbs, errors)} == {np.dtype(np.float64)}
    wanted = {tuple(point.xyz): (tuple(point.color), point.error) for point in model.points3D.values()}
    got = {tuple(xyz): (tuple(rgb), error) for xyz, rgb, (error,) in zip(xyzs, rgbs, errors, strict=True)}
    assert got == wanted


@pytest.mark.parametrize("suffix", ["bin", "txt"])
@pytest.mark.parametrize("whole", [True, False])
def test_a_models_views_and_points_are_those_of_pycolmap(model, folder, tmp_path, suffix, whole):
    """To the bit, and whether the rigs and frames of COLMAP 4 are there or not."""
    for name in ("cameras", "images", "points3D", "rigs", "frames")[: 5 if whole else 3]:
        shutil.copy(folder / f"{name}.{suffix}", tmp_path)
    _assert_equal(read_model(tmp_path), model)


def _assert_equal(got: ColmapModel, wanted: pycolmap.Reconstruction) -> None:
    assert len(got.images) == wanted.num_reg_images() > 0
    for photo, image_id in zip(got.images, sorted(wanted.reg_image_ids()), strict=True):
        image = wanted.images[image_id]
        camera, pose = wanted.cameras[image.camera_id], image.cam_from_world().matrix()
        assert (photo.name, photo.camera_id) == (image.name, image.camera_id)
        read = got.cameras[photo.camera_id]
        assert (read.model, read.width, read.height) == (camera.model_name, camera.width, camera.height)
        np.testing.assert_array_equal(read.params, camera.params)
        np.testing.assert_array_equal(np.column_stack([loader.qvec2rotmat(photo.qvec), photo.tvec]), pose)
    points = [wanted.points3D[point_id] for point_id in sorted(wanted.points3D)]
    np.testing.assert_array_equal(got.points.xyz, [point.xyz for point in points])
    np.testing.assert_array_equal(got.points.rgb, [point.color for point in points])


@pytest.mark.parametrize("suffix", ["bin", "txt"])
def test_rigs_of_several_cameras_and_frames_without_a_pose(tmp_path, suffix):
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 2, 3, 4, 50
    wanted = pycolmap.synthesize_dataset(options)
    wanted.deregister_frame(wanted.reg_frame_ids()[0])
    (wanted.write_binary if suffix == "bin" else wanted.write_text)(str(tmp_path))
    _assert_equal(read_model(tmp_path), pycolmap.Reconstruction(str(tmp_path)))


def test_without_pycolmap_what_needs_it_is_said(monkeypatch):
    monkeypatch.delitem(sys.modules, "pycolmap")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match="pycolmap is not installed, .*undistort the photos on another machine"):
        lens.import_pycolmap()


def test_an_empty_model_has_no_records(tmp_path):
    for name, (binary, text) in READERS.items():
        (tmp_path / "a.bin").write_bytes(bytes(8))
        (tmp_path / "a.txt").write_text("# nothing\n\n")
        for records in (binary(tmp_path / "a.bin"), text(tmp_path / "a.txt")):
            assert len(records) == 0 or [len(part) for part in records] == [0, 0, 0], name


def test_a_last_photo_without_its_second_line_has_no_points(tmp_path):
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 7 a.png\n\n2 1 0 0 0 0 0 0 7 b.png")
    images = loader.read_extrinsics_text(tmp_path / "images.txt")
    assert [(i.name, i.camera_id, i.xys.shape) for i in images.values()] == [("a.png", 7, (0, 2)), ("b.png", 7, (0, 2))]


def test_photos_without_their_second_lines_are_refused(tmp_path):
    """Else every second photo would be read as the points of the one before."""
    lines = [f"{i} 1 0 0 0 {i} 0 0 1 a photo {i}.jpg" for i in (1, 2, 3, 4)]
    (tmp_path / "images.txt").write_text("\n".join(lines))
    for reader in (loader.read_extrinsics_text, partial(loader.read_images, binary=False, with_points=False)):
        with pytest.raises(UserError, match="line 2"):
            reader(tmp_path / "images.txt")


@pytest.mark.parametrize(("name", "what"), [("cameras", "camera"), ("images", "photo"), ("points3D", "point")])
def test_a_file_cut_anywhere_is_refused_by_name(folder, tmp_path, name, what):
    whole = (folder / f"{name}.bin").read_bytes()
    path = tmp_path / f"{name}.bin"
    for size in [*range(0, len(whole), 37), len(whole) - 1]:
        path.write_bytes(whole[:size])
        with pytest.raises(UserError, match=f"{name}.bin (ends within {what}|is empty).*; copy the file again"):
            READERS[name][0](path)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-32"])
def test_text_of_any_encoding_and_indented_comments(folder, tmp_path, encoding):
    text = (folder / "images.txt").read_text(encoding="utf-8")
    (tmp_path / "images.txt").write_bytes(f"# comment\n  # indented\n{text}".encode(encoding))
    assert [image.name for image in loader.read_extrinsics_text(tmp_path / "images.txt").values()] == [
        image.name for image in loader.read_extrinsics_text(folder / "images.txt").values()
    ]


def test_a_comment_may_have_bytes_of_any_encoding(folder, tmp_path):
    content = "# Größe\n".encode("latin-1") + (folder / "cameras.txt").read_bytes()
    (tmp_path / "cameras.txt").write_bytes(content)
    assert len(loader.read_intrinsics_text(tmp_path / "cameras.txt")) == len(MODELS)
    name = (folder / "images.txt").read_text(encoding="utf-8").encode("latin-1")
    (tmp_path / "images.txt").write_bytes(name)
    with pytest.raises(UserError, match="not UTF-8 text; rename its photos"):
        loader.read_extrinsics_text(tmp_path / "images.txt")


def test_foreign_content_is_refused_in_words(folder, tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"\xff" * 500)
    for binary, text in READERS.values():
        with pytest.raises(UserError, match="file ends within|unknown camera model"):
            binary(path)
        with pytest.raises(UserError, match="not UTF-8"):
            text(path)
        with pytest.raises(FileNotFoundError):
            binary(tmp_path / "none")
        with pytest.raises(FileNotFoundError):
            text(tmp_path / "none")
    path.write_bytes(struct.pack("<QiiQQ", 1, 1, 99, 8, 6))
    with pytest.raises(UserError, match="camera 1 in .* unknown camera model 99"):
        loader.read_intrinsics_binary(path)
    path.write_bytes(struct.pack("<Qi7di", 1, 1, *range(7), 1) + b"\xff.png\0" + bytes(8))
    with pytest.raises(UserError, match="the name of photo 1 in .* is not UTF-8"):
        loader.read_extrinsics_binary(path)
    for text, line in (
        (loader.read_intrinsics_text, "1 PINHOLE 8 6 9 9 4"),
        (loader.read_intrinsics_text, "1 KODAK 8 6 9 9 4 3"),
        (loader.read_extrinsics_text, "1 1 0 0 0 0 0 0 7"),
        (loader.read_extrinsics_text, "1 1 0 0 0 0 0 0 7 a.png\n1 2"),
        (loader.read_points3D_text, "1 0 0 x 9 9 9 0.5"),
        (loader.read_points3D_text, "1 0 0 0 9 9 9"),
        (loader.read_points3D_text, "\n".join(["1 0 0 0 9 9 9"] * 8)),  # as many numbers as 7 points have
    ):
        path.write_text(f"# comment\n{line}\n")
        with pytest.raises(UserError, match="line [23] of .*file does not list"):
            text(path)


def test_quaternions_and_matrices():
    for rotation in Rotation.random(50, random_state=1):
        x, y, z, w = rotation.as_quat()
        wanted = np.array([w, x, y, z]) * (1 if w >= 0 else -1)
        for length in (1.0, 3.0, 1e-3):
            qvec = length * np.array([w, x, y, z])
            np.testing.assert_allclose(loader.qvec2rotmat(qvec), rotation.as_matrix(), atol=1e-14)
        np.testing.assert_allclose(loader.rotmat2qvec(rotation.as_matrix()), wanted, atol=1e-12)
    # Half turns, where w is 0 and the trace is least.
    for axis in np.eye(3):
        matrix = 2 * np.outer(axis, axis) - np.eye(3)
        np.testing.assert_allclose(np.abs(loader.rotmat2qvec(matrix)), [0, *axis], atol=1e-12)
    image = loader.Image(1, np.array([1.0, 0, 0, 0]), np.zeros(3), 1, "a", np.zeros((0, 2)), np.zeros(0, np.int64))
    np.testing.assert_array_equal(image.qvec2rotmat(), np.eye(3))
    assert np.isnan(loader.qvec2rotmat(np.zeros(4))).any()
    assert loader.Point3D._fields == ("id", "xyz", "rgb", "error", "image_ids", "point2D_idxs")


def test_dense_maps(tmp_path):
    path = tmp_path / "a.geometric.bin"
    for shape in ((4, 6), (4, 6, 3)):
        values = np.random.default_rng(0).normal(size=shape).astype(np.float32)
        # COLMAP runs through columns first, then rows, then channels.
        flat = values.reshape(4, 6, -1).transpose(2, 0, 1).tobytes()
        path.write_bytes(f"6&4&{values.size // 24}&".encode() + flat)
        array = loader.read_colmap_bin_array(str(path))
        np.testing.assert_array_equal(array, values)
        assert array.dtype == np.float32
    for content in (path.read_bytes()[:-1], b"6&4&", b"hello", b"a&b&c&"):
        path.write_bytes(content)
        with pytest.raises(UserError, match="not a complete dense map"):
            loader.read_colmap_bin_array(path)


def test_next_bytes():
    file = io.BytesIO(struct.pack("<idQ", -3, 0.5, 2**40) + struct.pack(">i", 7))
    assert loader.read_next_bytes(file, 20, "idQ") == (-3, 0.5, 2**40)
    assert loader.read_next_bytes(file, 4, "i", ">") == (7,)
