"""Depth maps: decoding, the choice of reliable ones, and the fit in depth_params.json."""

import json
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gaussians import pipeline
from PIL import Image
from synthetic import FakeGaussians, options_of

import train
from gaussian_renderer import render
from groundwork.files.image_files import write_plane
from scene import Scene, colmap_loader
from scene.dataset_readers import read_scene
from scene.gaussian_model import GaussianModel
from scene.readers import depth_scale
from scene.readers.colmap import ColmapModel, read_model, read_model_of_kind
from scene.readers.depth_maps import (
    DepthMap,
    Metric,
    inverses,
    map_names,
    map_size,
    read_values,
    resize,
    with_depth_maps,
)
from scene.readers.depth_scale import fit_image, fit_line, make_depth_params, sightings
from scene.readers.info import CameraInfo, SceneInfo
from splatting.features.depths import depth_loss
from utils import make_depth_scale
from utils.loss_utils import inverse_depth_loss
from utils.system_utils import UserError

ROOT = Path(__file__).parents[2]


def _save(values: np.ndarray, path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values).save(path)
    return path


def _random(shape: tuple[int, ...], dtype: type, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, shape, dtype=dtype, endpoint=True)


def test_values_come_as_they_are(tmp_path):
    for dtype in (np.uint8, np.uint16):
        grey = _random((9, 12), dtype)
        np.testing.assert_array_equal(read_values(_save(grey, tmp_path / "grey.png")), grey)
    equal = np.repeat(_random((9, 12, 1), np.uint8), 3, axis=2)
    np.testing.assert_array_equal(read_values(_save(equal, tmp_path / "equal.png")), equal[..., 0])


def test_what_is_no_depth_map_is_named(tmp_path):
    with pytest.raises(UserError, match="colored.png is coloured"):
        read_values(_save(_random((9, 12, 3), np.uint8), tmp_path / "colored.png"))

    # A PNG of one pixel, 16-bit RGB; Pillow alone would give only the upper bytes.
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 1, 1, 16, 2, 0, 0, 0)
    pixel = zlib.compress(b"\0" + struct.pack(">HHH", 300, 300, 300))
    content = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixel) + chunk(b"IEND", b"")
    (tmp_path / "deep.png").write_bytes(content)
    with pytest.raises(UserError, match="deep.png has 16-bit colours"):
        read_values(tmp_path / "deep.png")
    (tmp_path / "text.png").write_text("hello")
    with pytest.raises(UserError, match="cannot read the depth map .*text.png"):
        read_values(tmp_path / "text.png")


@pytest.mark.parametrize("size", [(5, 4), (31, 40), (1, 1)])
def test_resampling_against_torch(size):
    values = np.random.default_rng(0).random((9, 12))
    ours = resize(values, size)
    theirs = torch.nn.functional.interpolate(
        torch.from_numpy(values)[None, None], size[::-1], mode="bilinear", align_corners=False
    )[0, 0].numpy()
    np.testing.assert_allclose(ours, theirs, atol=1e-14)
    for lone in (values[:1], values[:, :1]):
        assert resize(lone, size).shape == size[::-1]


def test_scale_and_offset_in_double(tmp_path):
    grey = _random((9, 12), np.uint16)
    path = _save(grey, tmp_path / "a.png")
    whole = DepthMap(path, 65536.0, 2.5, -0.3).decode((12, 9))
    assert whole.shape == (1, 9, 12) and whole.dtype == torch.float32
    np.testing.assert_array_equal(whole[0].numpy(), (grey / 65536 * 2.5 - 0.3).astype(np.float32))
    assert whole.min() < 0  # negatives are cut off before the offset, as the reference does
    smaller = DepthMap(path, 512.0).decode((6, 5))[0].numpy()
    np.testing.assert_allclose(smaller, resize(grey / 512, (6, 5)), rtol=1e-7)


# Choice of reliable maps


@pytest.fixture
def scene(colmap_scene: Path) -> Path:
    """The COLMAP scene with a depth map for each photo, all with the same fit."""
    names = [image.name for image in read_model(colmap_scene / "sparse/0").images]
    for name in names:
        _save(_random((32, 48), np.uint16), (colmap_scene / "depths" / name).with_suffix(".png"))
    _write_params(colmap_scene, {name[: -len(".png")]: {"scale": 1.0, "offset": 0.0} for name in names})
    return colmap_scene


def _write_params(scene: Path, table: object) -> None:
    (scene / "sparse/0/depth_params.json").write_text(json.dumps(table))


def _params(scene: Path) -> dict:
    return json.loads((scene / "sparse/0/depth_params.json").read_text())


def _depths(scene: Path, hold_out: bool = False) -> dict[str, DepthMap | None]:
    info = with_depth_maps(read_scene(scene, "images", hold_out), scene, "depths/")
    assert all(camera.depth is None for camera in info.test_cameras)
    return {camera.image_name: camera.depth for camera in info.train_cameras}


def test_every_picture_has_its_map(scene, capsys):
    depths = _depths(scene)
    assert len(depths) == 17 and capsys.readouterr().err == ""
    for name, depth in depths.items():
        assert depth == DepthMap((scene / "depths" / name).with_suffix(".png"), 65536.0, 1.0, 0.0)
    assert len(_depths(scene, hold_out=True)) == 14


def test_unreliable_and_unknown_scales_give_no_loss_and_one_message(scene, capsys):
    table = _params(scene)
    first, second, third, fourth, fifth = sorted(table)[:5]
    table[first]["scale"], table[second]["scale"], table[third]["scale"] = 0.19, 5.1, 0.0
    table[fourth]["scale"] = 4.9
    del table[fifth]
    _write_params(scene, table)
    depths = _depths(scene)
    lost = {f"{name}.png" for name in (first, second, third, fifth)}
    assert {name for name, depth in depths.items() if depth is None} == lost
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and f"4 of 17 training photos have no depth loss: 1 not in {scene}" in said
    assert f"({fifth}.png), 3 with an unreliable scale there ({first}.png, {second}.png, {third}.png)" in said


def test_what_is_missing_or_broken_is_named(scene):
    table = _params(scene)
    some = sorted(table)[0]
    cases = {
        "not give a scale and an offset .*KeyError": {some: {"scale": 1.0}},
        "not give a scale and an offset .*AttributeError": [1],
        "not give a scale and an offset .*not finite": {some: {"scale": 1.0, "offset": float("nan")}},
        "17 of 17 training photos have no depth loss": {name: {"scale": 0.0, "offset": 0.0} for name in table},
    }
    for words, content in cases.items():
        _write_params(scene, content)
        with pytest.raises(UserError, match=f"{words}.*make_depth_scale.py"):
            _depths(scene)
    _write_params(scene, table)
    (scene / "depths" / f"{some}.png").unlink()
    with pytest.raises(UserError, match=f"1 of 17 depth maps are missing: .*{some}.png; put them there"):
        _depths(scene)
    (scene / "sparse/0/depth_params.json").unlink()
    with pytest.raises(UserError, match="no .*depth_params.json, .*`python utils/make_depth_scale.py --base_dir"):
        _depths(scene)
    (scene / "depths").rename(scene / "elsewhere")
    with pytest.raises(UserError, match="no folder of depth maps .*depths"):
        _depths(scene)


def test_renders_of_inverse_depth_tell_their_unit(blender_scene):
    planes = np.random.default_rng(0).uniform(0.1, 0.4, (4, 30, 40))
    for index, plane in enumerate(planes):
        write_plane(blender_scene / f"depths/r_{index}.png", plane)
    found = _depths(blender_scene, hold_out=True)["r_1"].decode((40, 30))[0].numpy()
    np.testing.assert_allclose(found, planes[1], atol=1e-4)


def test_blender_maps_are_found_by_name_or_by_path(blender_scene):
    for index in range(4):
        _save(np.full((30, 40), 256 * (index + 1), np.uint16), blender_scene / f"depths/r_{index}.png")
    depths = _depths(blender_scene, hold_out=True)
    assert depths["r_1"].decode((4, 4)).unique().tolist() == [1.0]  # 512 / 512
    with pytest.raises(UserError, match="4 of 6 depth maps are missing: .*depths/train/r_0.png"):
        _depths(blender_scene)  # nobody knows whether they belong to train or test
    for path in [*blender_scene.glob("train/*.png"), *blender_scene.glob("test/*.png")]:
        _save(np.ones((30, 40), np.uint16), blender_scene / "depths" / path.relative_to(blender_scene))
    assert all(depth.path.parent.name in ("train", "test") for depth in _depths(blender_scene).values())


@pytest.mark.parametrize(
    ("prefix", "place"), [("", "{}.png"), ("../images/", "{}.jpg.png"), ("{}/images/", "images/{}.png")]
)
def test_maps_are_found_below_their_folder_and_a_photo_is_no_map(tmp_path, prefix, place):
    """Grey photos, which could pass for maps."""
    names, cameras = [f"{side}/1" for side in ("left", "right")], []
    for name in names:
        photo = _save(np.full((30, 40), 9, np.uint8), tmp_path / "images" / f"{name}.jpg")
        named = f"{prefix.format(tmp_path)}{name}.jpg"
        cameras.append(CameraInfo(0, np.eye(3), np.zeros(3), 1.0, 1.0, None, photo, named, width=40, height=30))
        _save(np.full((30, 40), 512, np.uint16), tmp_path / "depths" / place.format(name))
        photo.with_suffix(".png").hardlink_to(photo)
    info = SceneInfo(None, cameras, [], {"radius": 1.0, "translate": np.zeros(3)}, None)
    found = [view.depth.path for view in with_depth_maps(info, tmp_path, "depths").train_cameras]
    assert found == [tmp_path / "depths" / place.format(name) for name in names]
    with pytest.raises(UserError, match="2 of 2 depth maps are missing: .*/images/.*left/1.png"):
        with_depth_maps(info, tmp_path, "images")
    if place == "{}.png":
        (tmp_path / "sparse" / "0").mkdir(parents=True)
        model = SimpleNamespace(images=[SimpleNamespace(name=camera.image_name) for camera in cameras])
        assert depth_scale._find_maps(tmp_path, tmp_path / "depths", model, None) == found
        assert depth_scale._find_maps(tmp_path, tmp_path / "images", model, None) == [None, None]


@pytest.mark.parametrize(("metric", "empty"), [*((True, one) for one in (0, -2, np.nan, -np.inf, 1e-310)), (False, 0)])
def test_maps_without_a_depth_are_named_and_left_out(blender_scene, empty, metric, capsys):
    def save(index: int, value: float) -> None:
        stem = blender_scene / "depths" / f"r_{index}"
        if metric:
            stem.parent.mkdir(exist_ok=True)
            np.save(f"{stem}.npy", np.full((30, 40), float(value)))
        else:
            _save(np.full((30, 40), 0 if value != 5 else 5, np.uint16), Path(f"{stem}.png"))

    for index in range(4):
        save(index, empty if index == 1 else 5)
    depths = _depths(blender_scene, hold_out=True)
    assert [name for name, depth in depths.items() if depth is None] == ["r_1"]
    assert re.search(r"1 of 4 depth maps in .*depths have no pixel .* left out: r_1\n", capsys.readouterr().err)
    for index in range(4):
        save(index, empty)
    with pytest.raises(UserError, match="4 of 4 depth maps in .*depths have no pixel with a depth above 0"):
        _depths(blender_scene, hold_out=True)


def test_one_pixel_at_the_camera_does_not_outweigh_the_map():
    distances = np.full((30, 40), 4.0)
    distances[3, 4], distances[5, 6], distances[7, 8] = 1e-310, 1e-5, 1e-2
    found = inverses(distances)
    assert np.isnan(found[3, 4]) and np.isnan(found[5, 6]) and found[7, 8] == 100 and np.nansum(found == 0.25) == 1197


# The fit


def test_the_line_is_robust_and_exact_without_outliers():
    mono = np.random.default_rng(0).random(200)
    assert fit_line(mono, 3 * mono - 0.2) == pytest.approx((3, -0.2), abs=1e-12)
    middle = np.median(2 * mono)
    spread = np.abs(2 * mono + 1 - middle - 1).mean() / np.abs(mono - np.median(mono)).mean()
    assert fit_line(mono, 2 * mono + 1) == pytest.approx((spread, middle + 1 - spread * np.median(mono)))
    flipped = 3 * mono - 0.2
    flipped[:5] = 100.0  # the fit uses medians, so the majority decides the offset
    scale, offset = fit_line(mono, flipped)
    assert scale * np.median(mono) + offset == pytest.approx(np.median(flipped))
    assert fit_line(mono[:10], mono[:10]) == (0, 0)
    assert fit_line(mono[:11], mono[:11]) != (0, 0)
    assert fit_line(mono, 1e-3 * mono) == (0, 0)
    assert fit_line(np.ones(20), mono[:20]) == (0, 0)


def test_points_are_looked_up_where_colmap_sees_them():
    """The map has twice the size and inverse depth linear in x; points behind the camera or outside do not count."""
    rng = np.random.default_rng(0)
    pixels = rng.uniform(1, 39, (40, 2))
    depths = 1 / (0.1 + 0.02 * pixels[:, 0])
    pixels[0], pixels[1], depths[2] = (-3, 5), (5, 41), -1
    ramp = np.repeat((np.arange(80)[None] + 0.5) / 2 / 100, 80, axis=0)
    scale, offset = fit_image(pixels, depths, (40, 40), ramp)
    assert (scale, offset) == pytest.approx((2.0, 0.1), abs=1e-9)


def _squares(view: colmap_loader.Image, model: ColmapModel, value: Callable[[float], float]) -> np.ndarray:
    """A map of eight times the photo's size: a square of value(depth) around each point that a view sees."""
    camera = model.cameras[view.camera_id]
    values = np.zeros((camera.height * 8, camera.width * 8))
    pixels, depths = sightings(view, model.points, camera, "")
    for (x, y), z in zip(pixels * 8, depths, strict=True):
        values[max(int(y) - 1, 0) : int(y) + 2, max(int(x) - 1, 0) : int(x) + 2] = value(z)
    return values


def test_the_command_makes_a_file_that_training_takes(colmap_scene, tmp_path, capsys):
    """Make maps of the points themselves: a square around each, with a scale and an offset per photo."""
    wanted = {}
    rng = np.random.default_rng(0)
    model = read_model_of_kind(colmap_scene / "sparse/0", "bin", with_2d_points=True)
    for view in model.images:
        scale, offset = rng.uniform(0.5, 1.5), rng.uniform(-0.02, 0.02)
        values = _squares(view, model, lambda z, scale=scale, offset=offset: (1 / z - offset) / scale)
        assert values.max() < 1
        _save((values * 65535).round().astype(np.uint16), (tmp_path / "maps" / view.name).with_suffix(".png"))
        wanted[view.name.removesuffix(".png")] = (scale, offset)
    make_depth_scale.main(["--base_dir", str(colmap_scene), "--depths_dir", str(tmp_path / "maps")])
    assert "17 of 17 photos have a depth map" in capsys.readouterr().out
    params = _params(colmap_scene)
    assert list(params[next(iter(params))]) == ["scale", "offset"]
    for name, (scale, offset) in wanted.items():
        # Some squares cover others, which disturbs means of distances most.
        assert (params[name]["scale"], params[name]["offset"]) == pytest.approx((scale, offset), rel=0.05, abs=0.02)
    (tmp_path / "maps").rename(colmap_scene / "depths")
    train.main(["-s", str(colmap_scene), "-m", str(tmp_path / "out"), "-d", "depths", "--iterations", "3", "-r", "24"])


@pytest.mark.parametrize("kind", ["png", "npy"])
def test_maps_of_the_opposite_kind_are_refused(colmap_scene, kind):
    """Millimetres without a metric.json, and inverse depth as floats; also where a training finds a fit of them."""
    model, folder = read_model_of_kind(colmap_scene / "sparse/0", "bin", with_2d_points=True), colmap_scene / "depths"
    for view in model.images:
        values = _squares(view, model, lambda z: z if kind == "png" else 1 / z)
        _save_metric(values, (folder / view.name).with_suffix(""), kind)
        if kind == "png":
            next(folder.rglob("metric.json")).unlink()
    said = (
        "are depths, not inverse depths.*put a file metric.json" if kind == "png" else "are inverse depths, not depths"
    )
    with pytest.raises(UserError, match=said):
        make_depth_scale.main(["--base_dir", str(colmap_scene), "--depths_dir", str(folder)])
    _write_params(colmap_scene, {view.name.removesuffix(".png"): {"scale": 1, "offset": 0} for view in model.images})
    if kind == "npy":
        (folder / "metric.json").write_text('{"units_per_metre": 1}')
    with pytest.raises(UserError, match=said):
        train.main(["-s", str(colmap_scene), "-m", str(colmap_scene / "out"), "-d", "depths", "--iterations", "3"])


@pytest.mark.parametrize("kind", ["OPENCV_FISHEYE", "EQUIRECTANGULAR"])
def test_depths_of_fisheyes_and_panoramas_are_distances(kind):
    """Also behind the camera, and also where the point is beside it."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(60, 3)) * (1, 1, 3)
    params = np.array([20.0, 20, 32, 32, 0, 0, 0, 0] if kind == "OPENCV_FISHEYE" else [64.0, 64])
    camera = colmap_loader.Camera(1, kind, 64, 64, params)
    turn, pixels = np.array([0.5, 0.5, -0.5, 0.5]), rng.uniform(0, 64, (60, 2))
    image = colmap_loader.Image(1, turn, np.array([0.1, 0.2, 0.3]), 1, "a.png", pixels, np.arange(60))
    cloud = colmap_loader.Points(np.arange(60), points, np.zeros((60, 3)), np.ones(60))
    center = -colmap_loader.qvec2rotmat(turn).T @ image.tvec
    found, depths = sightings(image, cloud, camera, "")
    np.testing.assert_allclose(depths, np.linalg.norm(points - center, axis=1))
    np.testing.assert_array_equal(found, pixels)
    local = points @ colmap_loader.qvec2rotmat(turn).T + image.tvec
    _, of_pinhole = sightings(image, cloud, camera._replace(model="PINHOLE"), "")
    np.testing.assert_allclose(of_pinhole, local[:, 2])


# Metric maps


def _save_metric(distances: np.ndarray, stem: Path, kind: str) -> None:
    """Distances (H, W) in metres, to the millimetre."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    if kind == "png":
        _save(np.nan_to_num(distances * 1000, nan=0, posinf=0).clip(0).round().astype(np.uint16), Path(f"{stem}.png"))
        (stem.parent / "metric.json").write_text('{"metres_per_step": 0.001}')
    elif kind == "npy":
        np.save(f"{stem}.npy", distances.astype(np.float32))
    else:  # rows from the bottom, of the byte order that the sign of the third number tells
        height, width = distances.shape
        sign, order = (-1, "<f4") if kind == "pfm" else (1, ">f4")
        content = f"Pf\n{width} {height}\n{sign}.0\n".encode() + distances[::-1].astype(order).tobytes()
        Path(f"{stem}.pfm").write_bytes(content)


@pytest.mark.parametrize("kind", ["png", "npy", "pfm", "pfm of big ends"])
def test_metric_maps_are_distances_with_gaps(tmp_path, kind):
    distances = np.random.default_rng(0).integers(500, 60_000, (9, 12)) / 1000
    known = np.ones((9, 12), dtype=bool)
    for place, gap in enumerate((0.0, np.nan, -1.0, np.inf)):
        distances[2 * place, 11] = gap
        known[2 * place, 11] = False
    _save_metric(distances, tmp_path / "a.b", kind)
    units = Metric.from_folder(tmp_path)._replace(scale=2.0)
    (place,) = tmp_path.glob("a.b.*")
    assert place.name in map_names(units)("a.b.jpg") and place.name in map_names(units)("a.b")
    found = units.map_of(place).decode((12, 9))[0].numpy()
    np.testing.assert_array_equal(np.isnan(found[:, 11]), ~known[:, 11])
    inside = np.isfinite(found)
    assert inside.mean() > 0.8
    np.testing.assert_allclose(found[inside], 1 / (2 * distances[inside]), rtol=1e-6)
    for file in {*tmp_path.glob("a.b.*")} - {*tmp_path.glob("*.png")}:
        file.write_bytes(file.read_bytes()[:-1])
        with pytest.raises(UserError, match="make it again"):
            map_size(file)


@pytest.mark.parametrize("kind", ["png", "npy"])
def test_one_scale_is_fitted_to_all_metric_maps(colmap_scene, kind, capsys):
    """Maps of the points themselves, 2.5 units a metre, with gaps elsewhere."""
    model = read_model_of_kind(colmap_scene / "sparse/0", "bin", with_2d_points=True)
    for view in model.images:
        values = _squares(view, model, lambda z: z / 2.5)
        _save_metric(values, (colmap_scene / "depths" / view.name).with_suffix(""), kind)
    if kind == "png":
        (colmap_scene / "depths/metric.json").write_text('{"metres_per_step": 0.001}')
    with pytest.raises(UserError, match="no units_per_metre in .*metric.json.*make_depth_scale.py --base_dir"):
        _depths(colmap_scene)
    make_depth_scale.main(["--base_dir", str(colmap_scene), "--depths_dir", str(colmap_scene / "depths")])
    assert "17 of 17 photos have a metric map: 2.5 units of the scene for each metre" in capsys.readouterr().out
    assert Metric.from_folder(colmap_scene / "depths").scale == pytest.approx(2.5, rel=1e-3)
    depths = _depths(colmap_scene)
    assert len(depths) == 17 and all(depth.metric for depth in depths.values())
    first = next(iter(depths.values()))
    known = first.decode((768, 512)).isfinite()
    assert 0.001 < known.float().mean() < 0.5
    train.main(["-s", str(colmap_scene), "-m", str(colmap_scene / "out"), "-d", "depths", "--iterations", "3"])
    first.path.unlink()
    assert sum(depth is None for depth in _depths(colmap_scene).values()) == 1
    assert "1 of 17 training photos have no depth map" in capsys.readouterr().err


def test_gaps_have_no_part_in_the_loss():
    depth, target = torch.tensor([[[0.1, 0.7, 0.3]]], requires_grad=True), torch.tensor([[[0.4, 0.0, 0.2]]])
    camera = SimpleNamespace(target_inverse_depth=target, depth_has_gaps=True, columns=None)
    (2 * depth_loss(depth, camera, None)).backward()
    assert depth.grad.tolist() == [[[-1.0, 0.0, 1.0]]]
    masked = depth_loss(depth, camera, torch.tensor([[[True, True, False]]]))
    assert masked.item() == pytest.approx(0.3)


def test_metric_maps_that_cannot_be_are_named(blender_scene):
    folder = blender_scene / "depths"
    with pytest.raises(UserError, match="no folder sparse in .*; name a COLMAP scene .*, or train .* without a fit"):
        make_depth_params(blender_scene, folder, "bin")
    _save_metric(np.ones((30, 40)), folder / "r_1", "npy")
    depths = _depths(blender_scene, hold_out=True)
    assert depths["r_1"] == DepthMap(folder / "r_1.npy", 1.0, metric=True) and depths["r_0"] is None
    np.save(folder / "r_1.npy", np.ones((40, 30)))
    with pytest.raises(UserError, match="r_1.npy has 30 x 40 pixels, but its photo has another aspect ratio, 40 x 30"):
        _depths(blender_scene, hold_out=True)
    np.save(folder / "r_1.npy", np.ones((30, 40), np.uint16))
    with pytest.raises(UserError, match="cannot read the depth map .*r_1.npy .*no array .height, width. of floats"):
        _depths(blender_scene, hold_out=True)
    (folder / "metric.json").write_text('{"metres_per_step": -1}')
    with pytest.raises(UserError, match="metric.json does not give metres_per_step or units_per_metre"):
        _depths(blender_scene)
    (folder / "metric.json").unlink()
    (folder / "r_1.npy").rename(folder / "other.npy")
    with pytest.raises(UserError, match="no depth map in .*depths is named like a training photo"):
        _depths(blender_scene)


# Training


def _train(scene: Path, out: Path, *more: object) -> bytes:
    train.main(["-s", str(scene), "-m", str(out), "-r", "24", "--iterations", "60", *map(str, more)])
    return (out / "point_cloud/iteration_60/point_cloud.ply").read_bytes()


def test_training_follows_the_maps_or_leaves_them_alone(scene, tmp_path):
    for path in (scene / "depths").rglob("*.png"):
        _save(np.full((64, 96), 6554, np.uint16), path)  # 0.1: all surfaces appear far behind their true depth
    plain = _train(scene, tmp_path / "plain")
    off = _train(scene, tmp_path / "off", "-d", "depths", "--depth_l1_weight_init", 0, "--depth_l1_weight_final", 0)
    assert off == plain
    weight = ("--depth_l1_weight_init", 20, "--depth_l1_weight_final", 20)  # the photos alone would give another depth
    assert _train(scene, tmp_path / "on", "-d", "depths", *weight) != plain
    error = {name: _depth_error(scene, tmp_path / name) for name in ("plain", "on")}
    assert error["on"] < 0.8 * error["plain"], error


def _depth_error(scene: Path, out: Path) -> float:
    options = options_of(scene, out, resolution=24, depths="depths")
    gaussians = GaussianModel(3)
    gaussians.load_ply(out / "point_cloud/iteration_60/point_cloud.ply")
    cameras = Scene(options, FakeGaussians(), shuffle=False, start=False).getTrainCameras()
    with torch.no_grad():
        losses = [
            inverse_depth_loss(
                render(camera, gaussians, pipeline(), torch.zeros(3), want_depth=True)["depth"], camera.invdepthmap
            )
            for camera in cameras
        ]
    return float(torch.stack(losses).mean())


def test_a_finished_model_needs_no_maps(scene):
    options = options_of(scene, scene / "model", depths="nowhere")
    (scene / "model/point_cloud/iteration_1").mkdir(parents=True)
    (scene / "model/point_cloud/iteration_1/point_cloud.ply").write_bytes(b"ply")
    cameras = Scene(options, FakeGaussians(), load_iteration=1).getTrainCameras()
    assert not any(camera.depth_reliable for camera in cameras)
    assert cameras[0].invdepthmap is None and cameras[0].depth_mask is None
