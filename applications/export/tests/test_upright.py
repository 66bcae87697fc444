"""Models of scenes that convert.py --orient has oriented: model.json, and exports in the upright frame."""

import argparse
import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from gaussians import pipeline
from html_scene import FOV, SIZE, balls
from html_scene import cameras as free_cameras
from plyfile import PlyData
from scipy.spatial.transform import Rotation
from small_splats import read_glb

import train
from applications.export.formats import SceneInputs, find_format
from applications.export.html import write_html
from applications.export.mesh import Mesh
from applications.export.mesh_files import write_glb_mesh
from applications.export.scene_formats import write_glb
from applications.export.upright import check_upright, move_cameras, move_inputs, move_splats, move_upright
from gaussian_renderer import render
from gaussian_renderer.camera_paths.poses import poses_of
from groundwork.files.json_files import read_model_json
from groundwork.files.similarity import Similarity, read_orientation
from scene.cameras import Camera
from scene.readers.info import CameraInfo
from scene.splats.reading import read_splats
from scene.with_splats import model_of
from utils.system_utils import UserError

TURN = Rotation.from_rotvec([1.0, -2.0, 0.5]).as_matrix()
SOME = Similarity(TURN, 2.5, np.array([3.0, -1.0, 0.5]))
RECORD = {"rotation": TURN.tolist(), "scale": 2.5, "translation": [3.0, -1.0, 0.5]}


def cameras() -> list[Camera]:
    """The ring of cameras as training views."""
    poses = poses_of(free_cameras())
    focal = SIZE[1] / 2 / math.tan(math.radians(FOV) / 2)
    size = {"width": SIZE[0], "height": SIZE[1], "image_path": ""}
    infos = [
        CameraInfo(n, turn, -turn.T @ place, fx=focal, fy=focal, image_name=str(n), **size)
        for n, (turn, place) in enumerate(zip(poses.turns, poses.positions, strict=True))
    ]
    return [Camera(info, SIZE, info.uid) for info in infos]


def rendered(splats, camera) -> np.ndarray:
    with torch.no_grad():
        return render(camera, model_of(splats), pipeline(), torch.zeros(3))["render"].numpy()


def around(make_path=None) -> SceneInputs:
    known = {"cameras": cameras(), "background": (0.0, 0.0, 0.0), "make_path": make_path}
    return SceneInputs(**{name: known.get(name) for name in SceneInputs._fields})


@pytest.mark.parametrize("scale", [2.5, 0.02])
def test_a_moved_model_looks_the_same_from_a_moved_camera(scale):
    """The model has SH degree 3. Float32 rounds to other values, so a few weights pass or fail the cutoff of 1/255."""
    similarity, splats, camera = replace(SOME, scale=scale), balls(degree=3), cameras()[1]
    moved, (other,) = move_splats(splats, similarity), move_cameras([camera], similarity)
    before, after = rendered(splats, camera), rendered(moved, other)
    assert before.max() > 0.5 and 10 * math.log10(1 / np.square(before - after).mean()) > 80
    assert np.abs(before - after).max() < 2 / 255
    assert np.abs(before - rendered(replace(moved, sh=splats.sh), other)).max() > 0.05
    assert camera.R is not other.R and np.abs(before - rendered(splats, camera)).max() == 0


def test_large_coordinates_lose_nothing():
    """The world's offset goes through the similarity in double, and the frame after it is small."""
    offset = np.array([455000.25, 5412000.5, 300.0])
    world = Similarity(TURN, 2.5, -2.5 * TURN @ (offset + 0.125))
    splats = replace(balls(degree=0), world_offset=tuple(offset))
    moved = move_splats(splats, world.from_local(offset))
    expected = world.transform(splats.means.astype(np.float64) + offset)
    np.testing.assert_allclose(moved.means, expected, atol=2e-6)
    assert moved.world_offset == (0, 0, 0) and np.abs(moved.means).max() < 10


def _args(folder: Path | str, upright=False, no_upright=False) -> argparse.Namespace:
    return argparse.Namespace(model_path=str(folder), source_path="", upright=upright, no_upright=no_upright)


def test_pages_and_meshes_are_upright_by_default_and_others_on_request(tmp_path):
    (tmp_path / "model.json").write_text(json.dumps({"similarity": RECORD, "world_offset": [1.0, 2.0, 3.0]}))
    splats = replace(balls(), world_offset=(1.0, 2.0, 3.0))
    moved = SOME.transform(splats.means.astype(np.float64) + [1.0, 2.0, 3.0])
    for of_scene, options, expected in (
        (True, {}, moved), (True, {"no_upright": True}, splats.means),
        (False, {}, splats.means), (False, {"upright": True}, moved),
    ):  # fmt: skip
        found, _ = move_upright(_args(tmp_path, **options), of_scene, splats, None)
        np.testing.assert_allclose(found.means, expected, atol=1e-5)
    check_upright(_args(tmp_path, upright=True))
    unknown = RECORD | {"vertical": None, "rotation": np.eye(3).tolist()}
    (tmp_path / "model.json").write_text(json.dumps({"similarity": unknown}))
    with pytest.raises(UserError, match="found no vertical"):
        check_upright(_args(tmp_path, upright=True))
    found = Similarity.read(unknown, "it")
    assert not move_inputs(around(), found).upright and move_inputs(around(), SOME).upright


@pytest.mark.parametrize("change", [
    *({"scale": value} for value in (1e300, 1e-300, 0, -1, 10**400)),
    *({"translation": value} for value in ([1e300, 0, 0], [[1], [1, 2]], [0, 0, None])),
    {"rotation": [[1], [1, 2]]},
    {"latitude": 1e300, "longitude": 0, "height": 0},
])  # fmt: skip
def test_a_similarity_that_leaves_no_scene_is_refused(tmp_path, change):
    for name, content in (("model.json", {"similarity": RECORD | change}), ("orientation.json", RECORD | change)):
        (tmp_path / name).write_text(json.dumps(content))
    for read in (lambda: move_upright(_args(tmp_path), True, balls(), None), lambda: read_orientation(tmp_path)):
        with pytest.raises(UserError, match="no rotation, scale and translation of a similarity that a scene may"):
            read()


def _trained(scene: Path, out: Path) -> Path:
    train.main(["-s", str(scene), "-m", str(out), "--iterations", "3", "--disable_viewer", "--quiet"])
    return out


def test_exports_are_oriented_as_the_scene_was_at_the_training_or_later(colmap_scene, tmp_path, run_export, capsys):
    """The last export is of a scene that has got other poses since."""
    model, written = _trained(colmap_scene, tmp_path / "model"), []
    assert "similarity" not in read_model_json(model)
    for name in ("plain", "upright"):
        run_export("-m", model, "--to", tmp_path / f"{name}.ply", *(["--upright"] if written else []))
        written.append(read_splats(tmp_path / f"{name}.ply").means)
        (colmap_scene / "orientation.json").write_text(json.dumps(RECORD | {"unit": "metre"}))
    np.testing.assert_allclose(written[1], SOME.transform(written[0]), atol=1e-5)
    assert read_model_json(_trained(colmap_scene, tmp_path / "other"))["similarity"] == RECORD | {"unit": "metre"}
    (colmap_scene / "orientation.json").unlink()
    run_export("-m", tmp_path / "other", "--to", tmp_path / "kept.ply", "--upright")
    np.testing.assert_allclose(read_splats(tmp_path / "kept.ply").means, written[1], atol=1e-5)
    assert "poses are not those" not in capsys.readouterr().err
    poses = json.loads((model / "cameras.json").read_text())
    for entry in poses:
        entry["position"][0] += 0.5
    (model / "cameras.json").write_text(json.dumps(poses))
    (colmap_scene / "orientation.json").write_text(json.dumps(RECORD))
    run_export("-m", model, "--to", tmp_path / "upright.ply", "--upright")
    assert "poses are not those" in capsys.readouterr().err


def textured(points: np.ndarray) -> Mesh:
    """A black triangle."""
    flat = points[:, :2].astype(np.float32)
    return Mesh(points, np.int32([[0, 1, 2]]), points, uv=flat, texture=np.zeros((4, 4, 3), np.uint8))


@pytest.mark.parametrize("place", [(47.25, 8.5, 410.0), ()])
@pytest.mark.parametrize("kind", ["splats", "mesh"])
def test_glb_tells_where_on_earth_it_is(tmp_path, place, kind):
    """-x of the turned node is east, y up, z north (README of EXT_georeference); x, y, z were east, down, north."""
    splats = replace(move_splats(balls(), replace(SOME, place=place)), world_offset=(0.0, 0.0, 0.0))
    if kind == "mesh":
        write_glb_mesh(tmp_path / "x.glb", textured(np.eye(3, dtype=np.float32)), splats)
    else:
        write_glb(tmp_path / "x.glb", splats)
    document, _ = read_glb(tmp_path / "x.glb")
    (node,) = document["nodes"]
    expected = {"EXT_georeference": {"latitude": 47.25, "longitude": 8.5}} if place else {}
    assert node.get("extensions", {}) == expected and ("EXT_georeference" in document["extensionsUsed"]) == bool(place)
    turn = Rotation.from_quat(node["rotation"]).as_matrix()
    np.testing.assert_allclose(turn, np.diag([-1, -1, 1] if place else [1, -1, -1]), atol=1e-9)


@pytest.mark.parametrize("upright", [True, False])
def test_a_ply_of_an_upright_mesh_has_z_up(tmp_path, monkeypatch, upright):
    """Blender reads x right, y down, z forward as x right, y forward, z up."""
    points = np.float32([[1, 2, 3], [4, 5, 6], [7, 8, 10]])
    mesh = replace(textured(points), colors=np.zeros((3, 3), np.uint8))
    monkeypatch.setattr("applications.export.mesh.measure_surfaces", lambda *_: ())
    monkeypatch.setattr("applications.export.mesh.make_mesh", lambda *_: (mesh, "a triangle"))
    for ending, expected in (("ply", points[:, [0, 2, 1]] * [1, 1, -1] if upright else points), ("glb", points)):
        path = tmp_path / f"mesh.{ending}"
        find_format(path).write(path, balls(), around()._replace(upright=upright))
        if ending == "ply":
            read = PlyData.read(path)["vertex"]
            found = np.column_stack([read[name] for name in "xyz"])
        else:  # its node turns it
            found = np.frombuffer(read_glb(path)[1], "<f4", 9).reshape(3, 3)
        np.testing.assert_array_equal(found, expected)


def test_a_page_takes_the_vertical_of_the_similarity(tmp_path):
    """Also where the cameras' horizons, all tilted here, say otherwise: the page's model is the moved one."""
    moved, places = move_splats(balls(), SOME), move_inputs(around(), SOME)
    settings = {}
    for name, value in (("kept", places), ("found", places._replace(upright=False))):
        write_html(tmp_path / f"{name}.html", moved, value.cameras, upright=value.upright)
        text = (tmp_path / f"{name}.html").read_text(encoding="utf-8")
        settings[name] = json.loads(re.search(r'<script[^>]*id="page"[^>]*>(.*?)</script>', text, re.S)[1])["settings"]
    position = poses_of(places.cameras).positions[0] * [-1, -1, 1]  # the viewer turns models half around z
    np.testing.assert_allclose(settings["kept"]["cameras"][0]["initial"]["position"], position, atol=1e-6)
    assert np.abs(settings["found"]["cameras"][0]["initial"]["position"] - position).max() > 0.1
