"""Exports of extreme models, and files of few bytes that ask for much memory."""

import contextlib
import gzip
import struct
import tempfile
import tracemalloc
import warnings
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from scipy.spatial import KDTree
from small_splats import empty_spz, splats, written

from scene.gaussian_model import GaussianModel
from splatting.exports.formats import read_splats
from splatting.exports.ply import CHUNK
from splatting.exports.splats import Splats, selected
from utils.system_utils import UserError

COUNT, FAR = 2000, 7  # splats, and the number of the one that lies apart


def cube(x: float | None = None, color: float | None = None) -> Splats:
    """Splats in a cube of half size 1, of which one has another x or SH0."""
    random = np.random.default_rng(0)
    some = splats(COUNT, 0)
    some.means[:] = random.uniform(-1, 1, (COUNT, 3))
    some.opacity_logits[:] = 0
    if x is not None:
        some.means[FAR] = [x, 0, 0]
    if color is not None:
        some.sh[FAR] = color
    return some


def moved(some: Splats, read: Splats) -> np.ndarray:
    """(COUNT - 1,) how far each of the others is from the nearest splat that was read and is seen."""
    seen = read.means[read.opacity_logits > -5].astype(np.float64)
    assert len(seen) <= COUNT
    return KDTree(seen).query(np.delete(some.means, FAR, axis=0))[0]


@pytest.mark.parametrize("x", [20, 1e3, -1e5, 1e30])
def test_one_far_gaussian_leaves_the_others_of_a_compressed_ply(tmp_path, x):
    some, path = cube(x), written(tmp_path, ".compressed.ply", cube(x))
    read = read_splats(path)
    alone = moved(cube(), read_splats(written(tmp_path, ".compressed.ply", cube(), "alone")))
    assert len(read) == COUNT and moved(some, read).max() <= alone.max() < 0.002
    np.testing.assert_allclose(read.means[-1], some.means[FAR])
    vertex = PlyData.read(path)["vertex"].data
    assert len(vertex) % CHUNK == 1 and (vertex["packed_color"] & 255 == 0).sum() == len(vertex) - COUNT


def test_one_gaussian_of_another_colour_leaves_the_others(tmp_path):
    some = cube(color=300)
    read = read_splats(written(tmp_path, ".compressed.ply", some))
    order = KDTree(some.means).query(read.means)[1]
    assert np.abs(read.sh - some.sh[order]).max() < 0.02 and sorted(order) == list(range(COUNT))


def test_far_gaussians_of_many_distances_keep_them(tmp_path):
    some = cube()
    some.means[:30] *= np.logspace(1, 30, 30)[:, None]
    read = read_splats(written(tmp_path, ".compressed.ply", some))
    assert len(read) == COUNT
    for mean in some.means[:30]:
        assert np.abs(read.means - mean).max(axis=1).min() < 0.02 * np.abs(mean).max()


@pytest.mark.parametrize("x", [20, 500, 1e4, -1e6, 1e30])
def test_one_far_gaussian_leaves_the_others_of_an_spz(tmp_path, capsys, x):
    """Beyond a thousand usual distances, here about 1, it is drawn in: seen from the middle it stays as it is."""
    some = cube(x)
    some.log_scales[FAR] = np.log(0.05 * abs(x))
    read = read_splats(written(tmp_path, ".spz", some))
    assert moved(some, read).max() < 2e-4
    number = np.abs(read.means[:, 0]).argmax()
    far, said = read.means[number], capsys.readouterr().err
    if abs(x) <= 500:
        np.testing.assert_allclose(far, some.means[FAR], atol=1e-3)
        assert said == ""
        return
    assert 900 < far[0] * np.sign(x) < 1100 and np.abs(far[1:]).max() < 0.1
    np.testing.assert_allclose(np.exp(read.log_scales[number]) / abs(far[0]), 0.05, rtol=0.05)  # also in its size
    assert said.startswith(f"warning: 1 of {COUNT} Gaussians lie more than") and "--crop leaves them out" in said


def test_positions_that_spz_cannot_hold_are_refused(tmp_path):
    with pytest.raises(UserError, match=r"can hold positions to 8,388,607, not 1e\+07; end --to with .ply"):
        written(tmp_path, ".spz", replace(cube(), means=cube().means + np.float32(1e7)))
    assert not list(tmp_path.iterdir())


@contextlib.contextmanager
def _little_memory(most: int = 5_000_000) -> Iterator[None]:
    tracemalloc.start()
    yield
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < most


@pytest.mark.parametrize("version", [3, 4])
def test_spz_unpacks_no_more_than_its_header_promises(tmp_path, version):
    path, bomb = tmp_path / "a.spz", bytes(50_000_000)
    if version == 3:
        path.write_bytes(gzip.compress(struct.pack("<IIIBBBB", 0x5053474E, 3, 1, 0, 12, 0, 0) + bomb))
    else:
        zstandard = pytest.importorskip("zstandard", reason="the extra [export] is not installed")
        content = bytearray(written(tmp_path, ".spz", splats(1, 0)).read_bytes())
        stream = zstandard.ZstdCompressor().compress(bomb)
        struct.pack_into("<Q", content, 32, len(stream))
        path.write_bytes(content[: 32 + 16 * 5] + stream)
    refused = pytest.raises(UserError, match="stream 0 does not have its 9 by")
    with _little_memory(), contextlib.nullcontext() if version == 3 else refused:
        read_splats(path)


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize(
    ("count", "degree", "said"),
    [(2_000_000, 0, r"it promises 2,000,000 rows in [\d,]+ bytes"), (500, 255, "SH bands of degree 255, of at most 4")],
)
def test_spz_of_few_bytes_and_much_content_is_refused(tmp_path, version, count, degree, said):
    if version == 4:
        pytest.importorskip("zstandard", reason="the extra [export] is not installed")
    (tmp_path / "a.spz").write_bytes(empty_spz(version, count, degree))
    with _little_memory(), pytest.raises(UserError, match=f"not a complete SPZ file .{said}.*; save or download it"):
        read_splats(tmp_path / "a.spz")


def test_splats_that_pack_well_are_read(tmp_path):
    """A lattice of equal splats takes 2 bytes each."""
    lattice = np.stack(np.meshgrid(*[np.arange(50.0)] * 3), axis=-1).reshape(-1, 3)
    some = replace(selected(splats(1, 0), np.zeros(len(lattice), int)), means=lattice.astype(np.float32))
    path = written(tmp_path, ".spz", some)
    assert path.stat().st_size < 3 * len(some) and len(read_splats(path)) == len(some)
    (tmp_path / "b.spz").write_bytes(empty_spz(3, 65_536))
    assert len(read_splats(tmp_path / "b.spz")) == 65_536


@pytest.mark.parametrize("ending", [".usdz", ".sog", ".compressed.ply"])
def test_without_a_temporary_folder_an_export_says_so(tmp_path, ending, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "absent"))
    monkeypatch.setattr("shutil.which", lambda name, **_: name)
    if ending == ".compressed.ply":  # which needs none
        assert len(read_splats(written(tmp_path, ending, splats(5)))) == 5
        return
    with pytest.raises(UserError, match=r"cannot make a temporary folder \(.*absent.*environment variable TMPDIR"):
        written(tmp_path, ending, splats(5))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("offset", [1e300, -1e16])
def test_an_offset_too_large_is_refused_by_the_name_of_the_file(tmp_path, offset):
    path = written(tmp_path, ".ply", replace(splats(5), world_offset=(0.0, offset, 0.0)), "mine")
    with pytest.raises(UserError, match=r"mine.ply lies 1e\+\d+ from the origin of its world.*comment world_offset"):
        read_splats(path)


@pytest.mark.parametrize("value", [1e300, -1e300, np.inf, np.nan])
@pytest.mark.parametrize("column", ["x", "f_dc_0", "opacity", "scale_0", "rot_0", "max_x", "max_scale_x", "max_r"])
def test_numbers_that_float32_cannot_hold_are_read_without_warnings(tmp_path, column, value):
    packed = column.startswith("max")
    path = written(tmp_path, ".compressed.ply" if packed else ".ply", splats(300, 0))
    first, *others = PlyData.read(path, mmap=False).elements
    rows = first.data.astype([(name, "f8") for name in first.data.dtype.names])
    rows[column][0] = value
    PlyData([PlyElement.describe(rows, first.name), *others], byte_order="<").write(str(path))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(read_splats(path)) == 300
        if not packed:
            GaussianModel(0).load_ply(path)
