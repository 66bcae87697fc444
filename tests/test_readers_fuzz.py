"""Readers give a valid result or a message of one sentence for any content of a file, quickly and in little memory."""

import argparse
import contextlib
import io
import json
import os
import shutil
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gaussians import model, options, take_steps
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from synthetic import make_blender_scene, make_colmap_scene

from arguments import ModelParams, read_cfg_args, read_model_json, write_cfg_args, write_model_json
from scene.dataset_readers import read_scene
from scene.gaussian_model import GaussianModel
from scene.gaussians.checkpoint import load_checkpoint, save_checkpoint
from scene.readers.colmap import read_model, read_model_of_kind
from scene.readers.depth_scale import sightings
from scene.readers.point_cloud import read_point_cloud, write_point_cloud
from utils.system_utils import UserError

EXAMPLES = int(os.environ.get("GS_FUZZ", 40))
# Files are below 1 MiB here, and readers may make several copies. A random start cloud takes 5 MB.
MOST_BYTES = 64 << 20
FUZZ = settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large],
)

# Values that people and programs put in the place of others.
SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**70), 2**70),
    st.sampled_from([0, 1, -1, 2**31, 2**32, 2**63, 10**400]),
    st.floats(),
    st.text(max_size=8),
    st.sampled_from(["", "..", "/", "\0", "x" * 5000, "./train/r_0", "\ud800"]),
)
JSON = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4)
)
NUMBERS = [b"-1", b"0", b"1e999", b"nan", b"9999999999999", b"99999999999999999999999", b"2147483648", b"x", b""]


def ends_well(read: Callable[[], object]) -> object | None:
    """Return a reader's result; None if it refuses with one sentence. Anything else fails the test."""
    tracemalloc.start()
    try:
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
            result = read()
    except UserError as error:
        assert "\n" not in str(error) or "\\n" in repr(str(error))
        result = None
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < MOST_BYTES, f"{peak >> 20} MiB for a small file"
    return result


@st.composite
def damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """Draw the bytes of a file with one to three damages."""
    data = bytearray(whole)
    for _ in range(draw(st.integers(1, 3))):
        start = draw(st.integers(0, len(data)))
        length = draw(st.integers(0, 64))
        kind = draw(st.sampled_from(["replace", "cut", "drop", "double", "number"]))
        if kind == "replace":
            new = draw(st.binary(max_size=16))
            data[start : start + len(new)] = new
        elif kind == "cut":
            del data[start:]
        elif kind == "drop":
            del data[start : start + length]
        elif kind == "double":
            data[start:start] = data[start : start + length]
        else:  # a number among the words of the first lines
            head, rest = data[:2000].split(b" "), data[2000:]
            number = draw(st.sampled_from(NUMBERS)) + draw(st.sampled_from([b"", b"\n"]))
            head[draw(st.integers(0, len(head) - 1))] = number
            data = bytearray(b" ".join(head)) + rest
    return bytes(data)


@st.composite
def changed(draw: st.DrawFn, content: Any, values: st.SearchStrategy) -> Any:
    """Draw a copy of nested lists, tuples and dicts with one to three entries changed, missing or added."""
    for _ in range(draw(st.integers(1, 3))):
        content = _change_one(draw, content, values)
    return content


def _change_one(draw: st.DrawFn, node: Any, values: st.SearchStrategy) -> Any:
    inner = isinstance(node, dict | list | tuple) and len(node)
    if not inner or draw(st.integers(0, 5)) == 0:
        return draw(values)
    keys = list(node) if isinstance(node, dict) else list(range(len(node)))
    key = draw(st.sampled_from(keys))
    copy = dict(node) if isinstance(node, dict) else list(node)
    if draw(st.integers(0, 5)) == 0:
        del copy[key]
    else:
        copy[key] = _change_one(draw, node[key], values)
    return tuple(copy) if isinstance(node, tuple) else copy


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


def _clouds(folder: Path) -> dict[str, bytes]:
    rng = np.random.default_rng(0)
    points, colors = rng.normal(size=(20, 3)), rng.integers(0, 256, (20, 3)).astype(np.uint8)
    write_point_cloud(folder / "cloud.ply", points, colors)
    np.savez(folder / "cloud.npz", points=points, colors=colors)
    header = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property float {name}\n" for name in "xyz")
    header += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue")) + "end_header\n"
    return {
        "binary": (folder / "cloud.ply").read_bytes(),
        "text": (header + "0 1 2 3 4 5\n0 1 2 3 4 5\n").encode(),
        "npz": (folder / "cloud.npz").read_bytes(),
        "table": b"x y z r g b\n1 2 3 4 5 6\n1 2 3 4 5 6\n",
    }


@pytest.mark.parametrize("kind", ["binary", "text", "npz", "table"])
@FUZZ
@given(data=st.data())
def test_point_cloud(folder, kind, data):
    path = folder / "damaged"
    path.write_bytes(data.draw(damaged(_clouds(folder)[kind])))
    cloud = ends_well(lambda: read_point_cloud(path))
    if cloud is not None:
        assert np.isfinite(cloud.points.astype(np.float32)).all()
        assert len(cloud.points) == len(cloud.colors) == len(cloud.normals)
        assert ((cloud.colors >= 0) & (cloud.colors <= 1)).all()


@pytest.fixture(scope="module")
def gaussian_ply(folder) -> bytes:
    model(7, 1).save_ply(folder / "whole.ply")
    return (folder / "whole.ply").read_bytes()


@FUZZ
@given(data=st.data())
def test_gaussian_ply(folder, gaussian_ply, data):
    path = folder / "gaussians.ply"
    path.write_bytes(data.draw(damaged(gaussian_ply)))
    gaussians = GaussianModel(1)
    ends_well(lambda: gaussians.load_ply(path))
    assert len({len(gaussians), *(len(rows) for rows in gaussians.rows().values())}) == 1


@FUZZ
@given(data=st.data())
def test_cfg_args(folder, data):
    options = ModelParams(argparse.ArgumentParser()).extract(argparse.Namespace(source_path="/data/it's", eval=True))
    write_cfg_args(folder, options)
    path = folder / "cfg_args"
    path.write_bytes(data.draw(damaged(path.read_bytes())))
    values = ends_well(lambda: read_cfg_args(folder))
    assert values is None or values.keys() <= vars(options).keys()


@FUZZ
@given(data=st.data())
def test_model_json(folder, data):
    path = folder / "model.json"
    write_model_json(folder, antialiasing=True, seed=3, world_offset=(1e6, 0.0, 3.0))
    if data.draw(st.booleans()):
        path.write_bytes(data.draw(damaged(path.read_bytes())))
    else:
        path.write_text(json.dumps(data.draw(changed(json.loads(path.read_text()), JSON))))
    record = ends_well(lambda: read_model_json(folder))
    assert record is None or np.isfinite(record.get("world_offset", 0.0)).all()


@pytest.fixture(scope="module")
def colmap_files(folder) -> dict[str, Path]:
    """COLMAP models by the kind of their files."""
    model = make_colmap_scene(folder / "colmap", views=3)
    for suffix, write in (("bin", model.write_binary), ("txt", model.write_text)):
        (folder / suffix).mkdir()
        write(str(folder / suffix))
    return {suffix: folder / suffix for suffix in ("bin", "txt")}


@pytest.mark.parametrize("suffix", ["bin", "txt"])
@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@FUZZ
@given(data=st.data())
def test_colmap_model(colmap_files, name, suffix, data):
    path = colmap_files[suffix] / f"{name}.{suffix}"
    whole = path.read_bytes()
    try:
        path.write_bytes(data.draw(damaged(whole)))
        model = ends_well(lambda: read_model(path.parent))
        whole_model = ends_well(lambda: read_model_of_kind(path.parent, suffix, with_2d_points=True))
    finally:
        path.write_bytes(whole)
    if model is not None:
        assert model.points.xyz.shape == model.points.rgb.shape == (len(model.points.ids), 3)
        assert all(image.qvec.shape == (4,) and image.tvec.shape == (3,) for image in model.images)
    for image in whole_model.images if whole_model else ():
        seen = ends_well(lambda image=image: sightings(image, whole_model.points, "the model"))
        assert seen is None or len(seen[0]) == len(seen[1])


@pytest.fixture(scope="module")
def camera_files(folder) -> dict[str, Path]:
    """Scenes by the name of their camera file."""
    make_blender_scene(folder / "blender", views=2)
    write_point_cloud(folder / "blender" / "points3d.ply", np.eye(3), np.zeros((3, 3), np.uint8))
    nerfstudio = folder / "nerfstudio"
    shutil.copytree(folder / "blender", nerfstudio)
    content = json.loads((nerfstudio / "transforms_train.json").read_text())
    content |= {"ply_file_path": "points3d.ply", "w": 40, "h": 30, "fl_x": 50.0, "k1": 0.0, "camera_model": "OPENCV"}
    for name in ("transforms_train.json", "transforms_test.json"):
        (nerfstudio / name).unlink()
    (nerfstudio / "transforms.json").write_text(json.dumps(content | {"test_filenames": ["./train/r_0.png"]}))
    return {"transforms_train.json": folder / "blender", "transforms.json": nerfstudio}


@pytest.mark.parametrize("name", ["transforms_train.json", "transforms.json"])
@FUZZ
@given(data=st.data(), hold_out=st.booleans())
def test_camera_file(camera_files, name, data, hold_out):
    path = camera_files[name] / name
    whole = path.read_bytes()
    try:
        if data.draw(st.booleans()):
            path.write_bytes(data.draw(damaged(whole)))
        else:
            path.write_text(json.dumps(data.draw(changed(json.loads(whole), JSON))))
        info = ends_well(lambda: read_scene(camera_files[name], "images", hold_out))
    finally:
        path.write_bytes(whole)
    if info is not None:
        for camera in info.train_cameras + info.test_cameras:
            assert np.isfinite([*camera.center, camera.fx, camera.fy, camera.cx, camera.cy]).all()
            np.testing.assert_allclose(camera.R @ camera.R.T, np.eye(3), atol=0.01)
            assert np.linalg.det(camera.R) > 0
            assert camera.fx > 0 and camera.fy > 0 and camera.width > 0 and camera.height > 0
        assert np.isfinite(info.extent) and info.extent > 0 and np.isfinite(info.point_cloud.points).all()


@pytest.fixture(scope="module")
def checkpoint(folder) -> bytes:
    gaussians = model(5, 1)
    take_steps(gaussians, 2)
    save_checkpoint(folder / "whole.pth", gaussians.capture(), 12)
    return (folder / "whole.pth").read_bytes()


TENSORS = st.sampled_from(
    [torch.zeros(0), torch.zeros(5), torch.zeros(5, 3, dtype=torch.float64), torch.zeros(5, 1, 3), torch.tensor(3.0)]
    + [torch.full((5, 3), float("nan")), torch.zeros(5, 3).to_sparse(), torch.zeros(1).expand(1 << 40)]
)


@FUZZ
@given(data=st.data())
def test_checkpoint(folder, checkpoint, data):
    path = folder / "damaged.pth"
    if data.draw(st.booleans()):
        path.write_bytes(data.draw(damaged(checkpoint)))
    else:
        (folder / "sound.pth").write_bytes(checkpoint)
        sound = torch.load(folder / "sound.pth", weights_only=True)
        torch.save(data.draw(changed(sound, SCALARS | TENSORS)), path)
    loaded = ends_well(lambda: load_checkpoint(path))
    if loaded is not None:
        gaussians = GaussianModel(1)
        restored = ends_well(lambda: gaussians.restore(loaded[0], options()) or gaussians)
        if restored is not None:
            take_steps(gaussians, 1)
            assert all(rows.isfinite().all() for rows in gaussians.rows().values())
