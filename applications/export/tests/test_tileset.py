"""tileset.json and lod-meta.json: Gaussians merged by moments, the octree, both formats, and what levels lose."""

import argparse
import dataclasses
import itertools
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from gaussians import pipeline
from scipy.spatial.transform import Rotation
from small_splats import extreme_splats, read_glb, splats

from applications.export import streamed, tiles3d
from applications.export.formats import SceneInputs, find_format
from applications.export.grouping import group_splats
from applications.export.levels import GROUP, build_octree, join_splats, measure_losses
from applications.export.merging import footprints, merge_groups, shadow_areas
from applications.export.sog import PROGRAM, run_program
from gaussian_renderer.camera_paths.without_scene import circle_cameras
from scene.splats.reading import read_splats
from scene.splats.splats import Splats, opacities, selected
from utils.system_utils import UserError


def _around(some: Splats) -> SceneInputs:
    return SceneInputs(circle_cameras(some.means)[:1], (0.0, 0.0, 0.0), pipeline(), None, None)


def _written(path: Path, some: Splats) -> dict:
    find_format(path).write(path, some, _around(some))
    return json.loads(path.read_text())


def _judged_covariances(some: Splats) -> np.ndarray:
    """By SciPy's rotations, which have the real part last."""
    turns = Rotation.from_quat(some.rotations[:, [1, 2, 3, 0]].astype(np.float64)).as_matrix()
    return np.einsum("nik,nk,njk->nij", turns, np.exp(2 * some.log_scales.astype(np.float64)), turns)


def test_merging_keeps_the_moments_of_each_group():
    some, starts = splats(50, 2), np.array([0, 1, 9, 30])
    one, spread = merge_groups(some, starts)
    weights = opacities(some) * shadow_areas(np.exp(some.log_scales.astype(np.float64)))
    ours, judged = _judged_covariances(one), _judged_covariances(some)
    for k, rows in enumerate(np.split(np.arange(50), starts[1:])):
        share = weights[rows] / weights[rows].sum()
        mean = share @ some.means[rows].astype(np.float64)
        apart = some.means[rows] - mean
        between = np.einsum("n,ni,nj->ij", share, apart, apart)
        covariance = np.einsum("n,nij->ij", share, judged[rows]) + between
        np.testing.assert_allclose(one.means[k], mean, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(ours[k], covariance, atol=2e-6 * np.abs(covariance).max())
        np.testing.assert_allclose(one.sh[k], np.einsum("n,nkc->kc", share, some.sh[rows]), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(spread[k], np.sqrt(np.trace(between)), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(footprints(one), np.add.reduceat(weights, starts), rtol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(one.rotations, axis=1), 1, atol=1e-6)


@pytest.mark.parametrize("count", [1, 4, 5, 63, 1000])
def test_groups_are_full_and_close(count):
    some = splats(count, 0)
    order, starts = group_splats(some, 4)
    sizes = np.diff(np.append(starts, count))
    assert sorted(order) == list(range(count)) and len(starts) == -(-count // 4)
    assert starts[0] == 0 and sizes.min() >= 1 and sizes.max() <= 4
    close, any_four = (merge_groups(each, starts)[1].mean() for each in (selected(some, order), some))
    assert count < 1000 or close < any_four / 2


def test_every_gaussian_is_in_one_leaf_and_levels_shrink():
    some = splats(3000, 1)
    some.means[7] = [1e6, 0, 0]
    root = build_octree(some, most=200)
    leaves = [tile.splats for tile in root.all() if not tile.children]
    assert max(map(len, leaves)) <= 200
    for name in ("means", "log_scales", "opacity_logits"):
        one, other = (np.sort(getattr(each, name), axis=0) for each in (join_splats(leaves), some))
        np.testing.assert_array_equal(one, other)
    inner = [tile for tile in root.all() if tile.children]
    assert all(len(tile.splats) == -(-sum(len(child.splats) for child in tile.children) // GROUP) for tile in inner)
    counts = [sum(len(tile.splats) for tile in root.level(depth)) for depth in range(root.levels)]
    assert counts == sorted(counts) and counts[-1] == 3000
    assert not build_octree(selected(some, np.zeros(500, int)), most=200).children  # copies, which no cell can split


def _corners(box: list[float]) -> tuple[np.ndarray, np.ndarray]:
    middle, half = np.array(box[:3]), np.array(box[3:]).reshape(3, 3)
    assert not (half - np.diag(np.diag(half))).any() and (np.diag(half) >= 0).all()
    return middle - np.diag(half), middle + np.diag(half)


def _positions(path: Path) -> np.ndarray:
    """POSITION of a GLB as a viewer of tiles places it: by the node's half turn, then from y up to z up."""
    gltf, binary = read_glb(path)
    assert gltf["nodes"][0]["rotation"] == [1, 0, 0, 0] and gltf["extensionsUsed"] == ["KHR_gaussian_splatting"]
    accessor = gltf["accessors"][gltf["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    view = gltf["bufferViews"][accessor["bufferView"]]
    flat = np.frombuffer(binary, "<f4", 3 * accessor["count"], view["byteOffset"]).reshape(-1, 3)
    turned = Rotation.from_quat([1, 0, 0, 0]).apply(flat)
    return Rotation.from_euler("x", 90, degrees=True).apply(turned)


def test_tilesets_are_as_3d_tiles_asks(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tiles3d, "build_octree", lambda some: build_octree(some, most=150))
    some = splats(1000, 1)
    tileset = _written(tmp_path / "tileset.json", some)
    assert tileset["asset"]["version"] == "1.1" and tileset["root"]["refine"] == "REPLACE"
    assert tileset["geometricError"] >= tileset["root"]["geometricError"]
    found, contents = [], []

    def check(tile: dict) -> None:
        low, high = _corners(tile["boundingVolume"]["box"])
        contents.append(tile["content"]["uri"])
        places = _positions(tmp_path / tile["content"]["uri"])
        slack = 1e-5 * np.abs([low, high]).max()
        assert (places >= low - slack).all() and (places <= high + slack).all()
        for child in tile.get("children", ()):
            below, above = _corners(child["boundingVolume"]["box"])
            assert (below >= low - slack).all() and (above <= high + slack).all()
            assert child["geometricError"] < tile["geometricError"]
            check(child)
        if "children" not in tile:
            assert tile["geometricError"] == 0
            found.append(places)

    check(tileset["root"])
    files = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.glb")}
    assert files == set(contents) and len(contents) == len(files) > 9
    leaves = np.concatenate(found)[:, [0, 2, 1]] * [1, -1, 1]
    np.testing.assert_allclose(np.sort(leaves, axis=0), np.sort(some.means, axis=0), atol=1e-5)
    printed = capsys.readouterr().out
    assert " 1,000 | " in printed and "equal" in printed and "photos" not in printed


def test_tiles_of_cesium_have_spz_in_place_of_attributes(tmp_path, monkeypatch):
    """All that CesiumJS 1.145 asks for; tests/browser/test_tiles.py shows them in it."""
    monkeypatch.setattr(tiles3d, "build_octree", lambda some: build_octree(some, most=150))
    some = splats(400, 2)
    tileset = _written(tmp_path / "cesium.json", some)
    both = ["KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"]
    assert tileset["extensions"]["3DTILES_content_gltf"] == {"extensionsUsed": both, "extensionsRequired": both}
    for tile in build_octree(some, most=150).all():
        (gltf, binary), count = read_glb(next(tmp_path.rglob(f"{tile.name}.glb"))), len(tile.splats)
        (primitive,) = gltf["meshes"][0]["primitives"]
        assert gltf["extensionsRequired"] == both and "rotation" not in gltf["nodes"][0]
        assert primitive["extensions"][both[0]]["extensions"] == {both[1]: {"bufferView": 0}}
        assert sum("SH_DEGREE_" in name for name in primitive["attributes"]) == 8  # without band 0
        assert all(accessor["count"] == count and "bufferView" not in accessor for accessor in gltf["accessors"])
        (tmp_path / "a.spz").write_bytes(binary[: gltf["bufferViews"][0]["byteLength"]])
        read = read_splats(tmp_path / "a.spz")
        for name, most in {"means": 1e-5, "log_scales": 1 / 30, "sh": 1 / 50}.items():
            np.testing.assert_allclose(getattr(read, name), getattr(tile.splats, name), rtol=0, atol=most)
        np.testing.assert_allclose(opacities(read), opacities(tile.splats), rtol=0, atol=0.002)
        cosines = np.abs((read.rotations * tile.splats.rotations).sum(axis=1))
        assert cosines.min() > 0.9985  # 0.998 if each byte were rounded to the nearest


@pytest.mark.parametrize("place", [(47.25, 8.5, 410), (-33.9, 151.2, -20), (90, 0, 0)])
def test_places_on_the_globe_are_those_of_colmap(place):
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap has no wheel for this platform")
    earth = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    points = np.random.default_rng(0).normal(scale=1000, size=(20, 3))  # metres east, north, up
    transform = np.reshape(tiles3d.place_on_globe(place), (4, 4)).T
    found = points @ transform[:3, :3].T + transform[:3, 3]
    np.testing.assert_allclose(found, earth.enu_to_ecef(points, *place), rtol=0, atol=1e-6)
    assert transform[3].tolist() == [0, 0, 0, 1]


def test_only_the_root_knows_the_place_on_the_globe(tmp_path, monkeypatch):
    """GLB that told it, too, would be turned: x y z were east, down, north, and are east, north, up in tiles."""
    monkeypatch.setattr(tiles3d, "build_octree", lambda some: build_octree(some, most=30))
    some = dataclasses.replace(splats(60, 0), place=(47.25, 8.5, 410.0))
    tileset = _written(tmp_path / "tileset.json", some)
    assert tileset["root"]["transform"] == tiles3d.place_on_globe(some.place)
    assert not any("transform" in tile for tile in tileset["root"]["children"])
    for tile in build_octree(some, most=30).all():
        found = _positions(next(tmp_path.rglob(f"{tile.name}.glb")))
        np.testing.assert_allclose(found, tile.splats.means[:, [0, 2, 1]] * [1, 1, -1], atol=1e-5)
    assert "transform" not in _written(tmp_path / "tileset.json", splats(60, 0))["root"]


@pytest.mark.parametrize("name", ["tileset.json", "cesium.json"])
def test_each_tileset_has_a_folder_of_its_own_which_a_new_one_replaces(tmp_path, name):
    one, other = tmp_path / f"a.{name}", tmp_path / f"b.{name}"
    first, second = _written(one, splats(20, 0)), _written(other, splats(20, 0))
    assert _written(one, splats(20, 0)) == first
    third = _written(one, splats(30, 0))
    folders = {content["asset"]["extras"]["folder"] for content in (second, third)}
    assert {entry.name for entry in tmp_path.iterdir()} == {one.name, other.name, *folders}
    assert (tmp_path / second["root"]["content"]["uri"]).is_file()


def test_only_a_folder_of_ours_goes_with_the_earlier_tileset(tmp_path, capsys):
    path, photos, count = tmp_path / "tileset.json", tmp_path / "tiles-2024", itertools.count(20)
    photos.mkdir(), (photos / "photo.jpg").touch()

    def stays(folder: str, reason: str) -> bool:
        _written(path, splats(30, 0))
        said = f"warning: the folder {tmp_path / folder} of the earlier tileset.json stays, as it {reason}"
        return (tmp_path / folder).is_dir() and said in capsys.readouterr().err

    def new() -> str:
        return _written(path, splats(next(count), 0))["asset"]["extras"]["folder"]

    for name in ("..", ".", "", "/", str(photos), "tiles-2024/../tiles-2024", 5, ["a"], None, "tiles-2024"):
        path.write_text(json.dumps({"asset": {"extras": {"folder": name}}}))
        capsys.readouterr()
        foreign = stays("tiles-2024", "was not written by an export for this file")
        assert (photos / "photo.jpg").is_file() and (foreign or name != "tiles-2024")
    folder = new()
    (tmp_path / folder / "mine.txt").touch()
    assert stays(folder, "was not written by an export for this file, or has changed since")
    folder = new()
    shutil.copy(path, tmp_path / "copy.JSON")
    assert stays(folder, "is named by copy.JSON")
    moved = (tmp_path / folder).rename(tmp_path / "moved")
    (tmp_path / folder).symlink_to(moved)
    (tmp_path / "copy.JSON").rename(path)
    assert stays(folder, "was not written") and any(moved.iterdir())


def test_a_failed_tileset_leaves_the_earlier_one(tmp_path, monkeypatch):
    path = tmp_path / "tileset.json"
    _written(path, splats(20, 0))
    before = {entry.name for entry in tmp_path.rglob("*")}

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    for name in ("write_glb", "make_document"):
        with monkeypatch.context() as patch, pytest.raises(UserError, match="No space left"):
            patch.setattr(tiles3d, name, full)
            _written(path, splats(30, 0))
        assert {entry.name for entry in tmp_path.rglob("*")} == before


NEAR = selected(extreme_splats(), np.arange(7))  # SPZ cannot hold the last one


@pytest.mark.parametrize(("name", "some"), [
    ("tileset.json", splats(0, 0)), ("cesium.json", splats(0, 0)),
    ("tileset.json", extreme_splats()), ("cesium.json", NEAR),
])  # fmt: skip
def test_empty_and_extreme_models_have_tilesets(tmp_path, some, monkeypatch, name):
    monkeypatch.setattr(tiles3d, "build_octree", lambda some: build_octree(some, most=2))
    tileset = _written(tmp_path / name, some)
    assert ("content" in tileset["root"]) == bool(len(some))
    assert np.isfinite(tileset["root"]["boundingVolume"]["box"]).all()


def test_tiles_of_cesium_refuse_positions_that_spz_cannot_hold(tmp_path):
    with pytest.raises(UserError, match=r"SPZ can hold positions to 8,388,607, not 1.*e\+30; leave the farthest out"):
        _written(tmp_path / "cesium.json", extreme_splats())
    assert not any(tmp_path.iterdir())


def test_finer_levels_lose_less():
    some = splats(1200, 0)
    root = build_octree(some, most=60)
    around = _around(some)
    found = measure_losses(root, around.cameras, around.background, argparse.Namespace(**vars(around.pipe)))
    scores = [level["psnr"] for level in found]
    assert scores[-1] is None and scores[:-1] == sorted(scores[:-1]) and scores[0] > 5
    assert all(level["photos"] is None for level in found) and torch.is_grad_enabled()


@pytest.mark.skipif(not shutil.which(PROGRAM), reason=f"{PROGRAM} is not on PATH: npm i -g @playcanvas/splat-transform")
def test_streamed_sog_has_every_level(tmp_path, monkeypatch):
    monkeypatch.setattr(streamed, "build_octree", lambda some: build_octree(some, most=250))
    some, path = splats(400, 0), tmp_path / "out" / "lod-meta.json"
    content = _written(path, some)
    root = build_octree(some, most=250)
    counts = [sum(len(tile.splats) for tile in root.level(depth)) for depth in range(root.levels)]
    assert content["counts"] == counts[::-1] and content["lodLevels"] == root.levels
    (finest,) = (name for name in content["filenames"] if "/0_" in name)
    run_program(PROGRAM, [str(path.parent / finest)], tmp_path / "read.ply", finest)
    read = read_splats(tmp_path / "read.ply")
    np.testing.assert_allclose(np.sort(read.means, axis=0), np.sort(some.means, axis=0), atol=1e-3)
    assert _written(path, some) == content
    assert {entry.name for entry in path.parent.iterdir()} == {path.name, content["asset"]["extras"]["folder"]}
