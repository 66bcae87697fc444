"""Exported files as programs read them that are not ours: PlayCanvas' splat-transform, Adobe's SPZ, Khronos' validator.

They come from npm: `npm ci --ignore-scripts` in tests/foreign installs the versions of its lock file.
"""

import argparse
import json
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from small_splats import splats, written
from torch import Tensor

from arguments import PipelineParams
from gaussian_renderer import render
from gaussian_renderer.camera_paths.poses import keyframe, look_along
from gaussian_renderer.free_view import free_view
from scene.cameras import MiniCam
from scene.splats.reading import read_splats
from scene.splats.splats import Splats, half_rotated, with_sh_degree
from scene.splats.spz import WRITTEN, write_spz
from scene.with_splats import model_of
from utils.system_utils import compute_device

pytestmark = pytest.mark.slow
FOREIGN = Path(__file__).parents[3] / "tests" / "foreign"
FLOAT, COMPRESSED = 60, 35  # dB that a format keeps at least
COUNT = 512  # as many as SOG has clusters for their SH bands, so that its loss does not hang on which ones it merges


@pytest.fixture(autouse=True)
def foreign_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Programs of tests/foreign on PATH; skips without them."""
    if shutil.which("node") is None:
        pytest.skip("Node is not installed")
    if not (FOREIGN / "node_modules").is_dir():
        pytest.skip("no programs to read exports with; run npm ci --ignore-scripts in tests/foreign")
    monkeypatch.setenv("PATH", str(FOREIGN / "node_modules/.bin"), prepend=":")


def read_by_splat_transform(path: Path) -> Splats:
    """The splats of a file as PlayCanvas' program reads them, which writes them as PLY."""
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder) / "model.ply"
        subprocess.run(["splat-transform", "--quiet", str(path), str(model)], check=True, capture_output=True)
        return read_splats(model)


def orbit(means: np.ndarray) -> list[MiniCam]:
    """Five square views on a circle around the middle of positions (N, 3), looking at it, -y up."""
    middle = np.median(means, axis=0).astype(np.float64)
    radius = 2.5 * float(np.median(np.linalg.norm(means - middle, axis=1)))
    views = []
    for angle in np.arange(5) * 2 * np.pi / 5 + 0.3:
        offset = np.array([np.sin(angle), -0.3, np.cos(angle)])
        pose = keyframe(0.0, middle + radius * offset, look_along(-offset, np.array([0.0, -1.0, 0.0])), 0.0)
        views.append(free_view(64, 64, 0.9, pose.position, pose.wxyz, compute_device()))
    return views


@torch.no_grad()
def renders(splats: Splats, cameras: list[MiniCam]) -> Tensor:
    """Images (V, 3, H, W) of the splats over black, with the render mode that they say."""
    pipe = PipelineParams(argparse.ArgumentParser()).extract(argparse.Namespace(antialiasing=splats.antialiasing))
    gaussians, black = model_of(splats), torch.zeros(3, device=compute_device())
    return torch.stack([render(camera, gaussians, pipe, black)["render"] for camera in cameras])


def decibels(one: Tensor, other: Tensor) -> float:
    """PSNR between images in [0, 1]; infinite if they are equal."""
    return float(-10 * (one - other).double().square().mean().log10())


def _scene(degree: int, antialiasing: bool = False) -> Splats:
    """Splats that fill the views, half of them opaque."""
    some = splats(COUNT, degree, antialiasing=antialiasing)
    some.log_scales[:] += 1.5
    return some


def _loss(some: Splats, read: Splats) -> float:
    """PSNR of the renders from 5 views, of which none may be empty."""
    cameras = orbit(some.means)
    expected = renders(some, cameras)
    assert expected.flatten(1).std(dim=1).min() > 0.05
    return decibels(renders(Splats(**{**vars(read), "antialiasing": some.antialiasing}), cameras), expected)


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("ending", [".ply", ".compressed.ply", ".splat", ".spz", ".sog"])
def test_splat_transform_reads_what_we_wrote(tmp_path, ending, degree):
    some = _scene(degree, antialiasing=degree == 3)
    path = written(tmp_path, ending, some)
    read = read_by_splat_transform(path)
    if ending == ".spz":
        read = half_rotated(read)  # this program does not convert between the axes of SPZ and PLY
    if ending == ".splat":
        some = with_sh_degree(some, 0)
    else:
        assert read.antialiasing == some.antialiasing
    assert len(read) == COUNT and read.sh_degree == some.sh_degree
    least = FLOAT if ending == ".ply" else COMPRESSED
    assert _loss(some, read) >= least
    if ending != ".sog":
        assert _loss(some, read_splats(path)) >= least


def test_a_sog_file_has_the_same_bytes_each_time(tmp_path, monkeypatch):
    """Although the program starts from random clusters and writes the time."""
    some = splats(COUNT + 88, 1)  # clusters shared by chance
    first = written(tmp_path, ".sog", some).read_bytes()
    time.sleep(2)  # the resolution of a date in a ZIP file
    monkeypatch.setenv("NODE_OPTIONS", "--no-warnings")  # options of the user's stay
    assert written(tmp_path, ".sog", some).read_bytes() == first


@pytest.mark.parametrize("version", WRITTEN)
def test_programs_read_the_versions_of_spz_that_the_guide_names(tmp_path, version):
    """Spark turns the splats into a file of its own, of another precision."""
    some, path, again = _scene(3), tmp_path / "a.spz", tmp_path / "again.spz"
    write_spz(path, some, version)
    assert _loss(some, half_rotated(read_by_splat_transform(path))) >= COMPRESSED
    done = subprocess.run(["node", FOREIGN / "read_spark.mjs", path, again], capture_output=True, text=True)
    if version == 4:
        assert "Invalid gzip header" in done.stdout
    else:
        assert done.returncode == 0, done.stdout + done.stderr
        assert _loss(some, read_splats(again)) >= COMPRESSED


@pytest.mark.parametrize(("degree", "version"), [(0, 4), (3, 4), (3, 3), (3, 2)])
def test_adobes_spz_reads_what_we_wrote(tmp_path, degree, version):
    some = _scene(degree, antialiasing=True)
    path = tmp_path / "model.spz"
    write_spz(path, some, version)
    target = tmp_path / "read.json"
    subprocess.run(["node", FOREIGN / "read_spz.mjs", path, target], check=True, capture_output=True)
    read = json.loads(target.read_text())
    assert (read["count"], read["degree"], read["antialiased"]) == (COUNT, degree, True)

    def values(name: str, *shape: int) -> np.ndarray:
        numbers = [np.inf if x is None else x for x in read[name]]  # JSON has no infinity, the logit of 1
        return np.array(numbers, dtype=np.float32).reshape(COUNT, *shape)

    sh = np.concatenate([values("colors", 1, 3), values("sh", (degree + 1) ** 2 - 1, 3)], axis=1)
    rotations = np.roll(values("rotations", 4), 1, axis=1)
    theirs = Splats(values("positions", 3), values("scales", 3), rotations, values("alphas"), sh, True)
    assert _loss(some, theirs) >= COMPRESSED
    ours = read_splats(path)
    np.testing.assert_allclose(ours.means, theirs.means, atol=1e-6)
    np.testing.assert_allclose(ours.log_scales, theirs.log_scales, atol=1e-6)
    np.testing.assert_allclose(ours.sh, theirs.sh, atol=1e-5)
    one, other = ours.rotations, theirs.rotations
    lengths = np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)  # which version 2 rounds
    np.testing.assert_allclose(np.abs((one * other).sum(axis=1)) / lengths, 1, atol=1e-5)


@pytest.mark.parametrize(
    ("ending", "options"), [(".spz", []), (".spz", ["--spz-version", "3"]), (".compressed.ply", [])]
)
def test_we_read_what_splat_transform_writes(tmp_path, ending, options):
    some = _scene(2, antialiasing=True)
    plain, packed = written(tmp_path, ".ply", some), tmp_path / f"theirs{ending}"
    subprocess.run(["splat-transform", "--quiet", *options, plain, packed], check=True, capture_output=True)
    read = read_splats(packed)
    assert read.antialiasing and read.sh_degree == 2
    assert _loss(some, half_rotated(read) if ending == ".spz" else read) >= COMPRESSED


@pytest.mark.parametrize("count", [0, 1, 50])
def test_khronos_validator_accepts_glb(tmp_path, count):
    """The validator knows no attributes of the extension, and names each an invalid one; nothing else may be wrong."""
    path = written(tmp_path, ".glb", splats(count, 1))
    done = subprocess.run(["node", FOREIGN / "check_gltf.mjs", path], check=True, capture_output=True, text=True)
    report, known = json.loads(done.stdout), "/meshes/0/primitives/0/attributes/KHR_gaussian_splatting:"
    for message in report["issues"]["messages"]:
        if message["severity"] < 2:  # errors and warnings
            assert message["code"] == "MESH_PRIMITIVE_INVALID_ATTRIBUTE" and message["pointer"].startswith(known)
    assert not report["issues"]["truncated"] and report["info"]["totalVertexCount"] == count
