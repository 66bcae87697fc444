"""Exports of other programs: each made from one scene, whose points must fall where pycolmap projects them."""

import shutil
from functools import partial
from pathlib import Path

import exports_of_programs as programs
import numpy as np
import pycolmap
import pytest
from lenses import opencv_pixels
from PIL import Image
from synthetic import BROWN, edit_json, make_colmap_scene, read

from scene.readers.info import CameraInfo
from utils.system_utils import UserError

VIEWS = 9
FISHEYE = (60.0, 60.5, 45.0, 34.5, 0.05, -0.01, 0.003, -0.001)
FULL = (*BROWN[:2], 45.0, 34.5, -0.2, 0.03, 0.004, -0.003, 0.01, 0.0, 0.0, 0.0)
LENSES = {"PINHOLE": (110.0, 112.0, 45.0, 34.5), "OPENCV": BROWN, "FULL_OPENCV": FULL, "OPENCV_FISHEYE": FISHEYE}
LAYOUTS = {
    "realityscan": (programs.realityscan, "PINHOLE"),
    "opf2colmap": (programs.opf2colmap, "FULL_OPENCV"),
    "nerfstudio": (programs.nerfstudio, "OPENCV"),
    "nerfcapture": (programs.nerfcapture, "PINHOLE"),
    "polycam": (programs.polycam, "PINHOLE"),
    "polycam_arkit": (partial(programs.polycam, corrected=False), "PINHOLE"),
    "record3d": (programs.record3d, "PINHOLE"),
    "record3d_r3d": (partial(programs.record3d, r3d=True), "PINHOLE"),
    "metashape": (programs.metashape, "OPENCV"),
    "metashape_fisheye": (programs.metashape, "OPENCV_FISHEYE"),
    "metashape_rig": (partial(programs.metashape, rig=True), "OPENCV"),
}


@pytest.fixture
def make(tmp_path, once):
    """A function that makes a layout of LAYOUTS: its folder, the model before, the points in the export's world."""

    def made(layout: str) -> tuple[Path, pycolmap.Reconstruction, np.ndarray]:
        write, lens = LAYOUTS[layout]
        master = once(f"scene_{lens}", partial(make_colmap_scene, model=lens, params=LENSES[lens], views=VIEWS))
        folder = tmp_path / layout
        folder.mkdir()
        sparse = str(master / "sparse" / "0")
        points = write(pycolmap.Reconstruction(sparse), master / "images", folder)
        return folder, pycolmap.Reconstruction(sparse), points

    return made


def _pixels(view: CameraInfo, points: np.ndarray) -> np.ndarray:
    """Return the pixels (N, 2) of points in a view, centres at .5.

    points: (N, 3).
    """
    local = points @ view.R + view.T
    if view.native is not None:
        return opencv_pixels(view.native, local)
    return local[:, :2] / local[:, 2:] * (view.fx, view.fy) + (view.cx, view.cy)


def _by_photo(info, images: Path, model: pycolmap.Reconstruction) -> list[tuple[CameraInfo, pycolmap.Image]]:
    """Views with the image of the model that has their photo, by its pixels."""
    small = {image.image_id: np.asarray(Image.open(images / image.name), float) for image in model.images.values()}
    found = []
    for view in info.train_cameras:
        pixels = np.asarray(Image.open(view.image_path), float)
        errors = {number: np.abs(pixels - other).mean() for number, other in small.items()}
        best = min(errors, key=errors.get)
        assert errors[best] < sorted(errors.values())[1] / 4  # of the same photo as JPEG, and of the next one
        found.append((view, model.images[best]))
    return found


@pytest.mark.parametrize("layout", LAYOUTS)
def test_points_fall_where_pycolmap_projects_them(make, once, layout):
    folder, model, points = make(layout)
    has_points = layout in ("realityscan", "opf2colmap", "nerfstudio") or layout.startswith("metashape")
    info = read(folder, native=True, init_type="sfm" if has_points else "random")
    lens = LAYOUTS[layout][1]
    pairs = _by_photo(info, once(f"scene_{lens}", lambda _: None) / "images", model)
    assert len({image.image_id for _, image in pairs}) == VIEWS
    errors = []
    for view, image in pairs:
        expected = [image.project_point(point) for point in programs.points_of(model)]
        seen = np.array([pixel is not None for pixel in expected])
        errors.extend(np.linalg.norm(_pixels(view, points[seen]) - np.array(expected)[seen], axis=1))
    assert len(errors) > 1000
    assert np.mean(errors) < 1e-3 and np.max(errors) < 1e-2
    if has_points:
        np.testing.assert_allclose(np.sort(info.point_cloud.points, axis=0), np.sort(points, axis=0), atol=1e-5)


def test_what_is_left_out_is_said(make, capsys):
    folder, _, _ = make("metashape")
    read(folder)
    assert "1 cameras of" in (said := capsys.readouterr().err) and "or are not enabled: unaligned" in said
    assert "not used" not in said
    _replaced(_XML, "<k1>", "<k5>0.1</k5><rolling_shutter /><k1>")(folder)
    read(folder)
    assert "elements of" in (said := capsys.readouterr().err) and "not used: k5, rolling_shutter\n" in said
    folder, _, _ = make("metashape_rig")
    _replaced(_XML, "location", "offset")(folder)
    _replaced(_XML, "rotation", "turn")(folder)
    assert len(read(folder).train_cameras) == 1
    assert "have no place in their rig" in (said := capsys.readouterr().err) and "used: offset, turn" in said
    folder, _, _ = make("polycam")
    read(folder, init_type="random")
    assert capsys.readouterr().err == ""
    next((folder / "keyframes" / "corrected_images").iterdir()).unlink()
    assert len(read(folder, init_type="random").train_cameras) == VIEWS - 1
    assert "1 photos or cameras of" in capsys.readouterr().err
    folder, _, _ = make("record3d")
    edit_json(folder / "metadata.json", lambda content: content["poses"].pop())
    assert len(read(folder, init_type="random").train_cameras) == VIEWS - 1
    assert "1 photos or cameras of" in capsys.readouterr().err


def _replaced(name: str, old: str, new: str):
    def change(folder: Path) -> None:
        path = next(folder.glob(name))
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))

    return change


_XML, _JSON, _META = "cameras.xml", "keyframes/corrected_cameras/*.json", "metadata.json"


@pytest.mark.parametrize(
    ("layout", "change", "message"),
    [
        ("metashape", _replaced(_XML, "<k1>", "<k4>0.1</k4><k1>"), "not supported for .* type frame: k4; .* or export"),
        ("metashape", _replaced(_XML, "<k1>", "<corrections /><k1>"), "not supported for cameras of .*: corrections;"),
        ("metashape_fisheye", _replaced(_XML, "<k1>", "<p1>1e-3</p1><k1>"), "not supported for .* type fisheye: p1"),
        ("metashape", _replaced(_XML, 'type="frame"', 'type="rpc"'), "unsupported type rpc; export .*Colmap"),
        ("metashape", _replaced(_XML, "calibration", "other"), "has no calibration; align its photos"),
        ("metashape", _replaced(_XML, "<f>", "<f>a "), "cannot be read .*export them again"),
        ("metashape", _replaced(_XML, "0.0 1.0</transform>", "0.0 1.0 2.0</transform>"), "has 17 numbers and needs 16"),
        *(
            ("metashape", _replaced(_XML, "2.5</scale>", f"{value}</scale>"), "component in .* has the scale")
            for value in ("-1", "nan", "1e-300")
        ),
        ("metashape", _replaced(_XML, "chunk", "chunks"), "has 0 chunks and needs one; choose Export Cameras"),
        ("metashape", _replaced(_XML, "component_id", 'enabled="false" component_id'), "has no aligned camera; align"),
        ("metashape", lambda folder: shutil.copy(folder / _XML, folder / "b.xml"), "several files .*b.xml, came"),
        ("metashape", lambda folder: shutil.rmtree(folder / "images/left"), "5 of 9 .*missing: .*/images/V00.png, "),
        ("polycam", _replaced(_JSON, '"fx"', '"f"'), r"cameras/\d+.json is not a camera file .*'fx'.; export"),
        ("polycam", _replaced(_JSON, '"fx": ', f'"fx": 1{"0" * 400}, "was": '), "OverflowError.*; export the capture"),
        ("polycam", _replaced(_JSON, '"t_00": ', '"t_00": 1e400, "was": '), "frame . .*keyframes has no usable pose"),
        ("record3d", _replaced(_META, '"poses"', '"perFrameIntrinsicCoeffs": [[1, 1, 1]], "poses"'), "of the shape"),
    ],
)
def test_broken_exports_are_refused(make, layout, change, message):
    folder, _, _ = make(layout)
    change(folder)
    with pytest.raises(UserError, match=message) as refused:
        read(folder, init_type="random")
    assert "\n" not in str(refused.value)


def test_archives_are_to_be_unpacked(make, tmp_path):
    folder, _, _ = make("record3d_r3d")
    shutil.make_archive(str(tmp_path / "capture"), "zip", folder)
    (tmp_path / "phone").mkdir()
    archive = (tmp_path / "capture.zip").rename(tmp_path / "phone" / "capture.r3d")
    with pytest.raises(UserError, match="capture.r3d is an archive .*unpack it"):
        read(archive)
    with pytest.raises(UserError, match="unpack capture.r3d .*give -s the folder that comes out"):
        read(archive.parent)
    shutil.unpack_archive(archive, tmp_path / "phone" / "out", "zip")
    assert len(read(tmp_path / "phone" / "out", init_type="random").train_cameras) == VIEWS
