"""Exported files: read back by our own readers, equal bytes, extreme models, and few bytes that ask for much."""

import contextlib
import gzip
import json
import struct
import tracemalloc
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from gaussians import model
from plyfile import PlyData
from scipy.spatial import KDTree, cKDTree
from small_splats import COUNT, FAR, cube, empty_spz, extreme_splats, moved, splats, written

from applications.export import scene_formats
from applications.export.formats import FORMATS, find_format
from gaussian_renderer.free_view import rotation_matrix
from scene.export_world import export_world
from scene.splats import ply
from scene.splats import splats as splats_module
from scene.splats.ply import CHUNK
from scene.splats.reading import read_splats
from scene.splats.splats import (
    Splats,
    drawable,
    half_rotated,
    logits,
    opacities,
    selected,
    tidy,
    with_sh_degree,
    within_box,
)
from scene.splats.spz import WRITTEN, packed_spz, write_spz
from scene.with_splats import model_of, splats_of
from utils.sh_utils import C0, sh_basis
from utils.system_utils import UserError

READABLE = (".ply", ".compressed.ply", ".splat", ".spz")
OURS = (*READABLE, ".glb", ".usdz")  # not those that other programs write


def _matched(some: Splats, read: Splats) -> Splats:
    """The splats of `read` in the order of `some`: each is the nearest to its position."""
    found = KDTree(read.means).query(some.means)[1]
    assert sorted(found) == list(range(len(some))) == list(range(len(read)))
    return selected(read, found)


def _angles(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Angles, radians, between orientations."""
    return 2 * np.arccos(np.clip(np.abs((one.astype(np.float64) * other).sum(axis=1)), 0, 1))


# What a format loses, by its definition half a step of its rounding: position, log scale, angle, opacity, SH0, SH.
BYTE = 0.5 / 255
LOSSES = {
    ".ply": (0, 0, 1e-3, 0, 0, 0),
    ".splat": (0, 1e-6, 0.03, BYTE, BYTE / C0, 0),
    ".compressed.ply": (8 / 1023 / 2, 8 / 1023 / 2, 4e-3, BYTE, 4 * BYTE, 8 / 256 / 2),
    ".spz": (2**-20, 1 / 32, 6e-3, BYTE, BYTE / 0.15, 1 / 256),
}


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("ending", READABLE)
def test_round_trips_lose_what_the_format_rounds(tmp_path, ending, degree):
    some = splats(300, degree, antialiasing=True)
    read = read_splats(written(tmp_path, ending, some))
    assert read.antialiasing == (ending != ".splat")
    assert read.sh_degree == (0 if ending == ".splat" else degree)
    some, read = with_sh_degree(some, read.sh_degree), _matched(some, read)
    shown = np.abs(some.sh[:, 0] * C0) < (0.5 if ending == ".splat" else np.inf)  # .splat cuts off other colours
    differences = (
        np.abs(some.means - read.means),
        np.abs(some.log_scales - read.log_scales),
        _angles(some.rotations, read.rotations),
        np.abs(opacities(some) - opacities(read)),
        np.abs(some.sh[:, 0] - read.sh[:, 0])[shown],
        np.abs(some.sh[:, 1:] - read.sh[:, 1:]),
    )
    for difference, loss in zip(differences, LOSSES[ending], strict=True):
        assert difference.max(initial=0) <= loss * 1.001 + 1e-6


@pytest.mark.parametrize("count", [0, 1, 300])
def test_a_ply_in_the_worlds_coordinates_keeps_its_decimals(tmp_path, count):
    some, far = splats(count, 1), np.array([500_000.0, 5_400_000.0, 200.0])
    export_world(written(tmp_path, ".ply", some), far, tmp_path / "world.ply")
    read = read_splats(tmp_path / "world.ply")
    if count < 2:  # without an extent nothing is far
        assert len(read) == count and read.world_offset == (0.0, 0.0, 0.0)
        return
    assert any(read.world_offset) and all(value % 10 == 0 for value in read.world_offset)
    places = read.means.astype(np.float64) + read.world_offset
    np.testing.assert_allclose(places, some.means + far, rtol=0, atol=1e-5)
    export_world(written(tmp_path, ".ply", some), np.ones(3), tmp_path / "near.ply")
    np.testing.assert_array_equal(read_splats(tmp_path / "near.ply").means, (some.means + 1.0).astype(np.float32))


@pytest.mark.parametrize("count", [0, 257])
@pytest.mark.parametrize("ending", OURS)
def test_the_same_splats_give_the_same_bytes(tmp_path, ending, count):
    one, other = (written(tmp_path, ending, splats(count, 2), name) for name in ("one", "other"))
    assert one.read_bytes() == other.read_bytes()
    if ending == ".usdz":  # the two were perhaps written in one of ZIP's steps of 2 seconds
        with zipfile.ZipFile(one) as archive:
            assert archive.infolist()[0].date_time == (1980, 1, 1, 0, 0, 0) and archive.testzip() is None
    if ending in READABLE:
        read = read_splats(one)
        assert drawable(read).shape == (count,) and drawable(read).all()


@pytest.mark.parametrize("ending", READABLE)
def test_extreme_values_stay_finite_and_in_their_place(tmp_path, ending):
    some = extreme_splats()
    read = read_splats(written(tmp_path, ending, some))
    assert len(read) == len(some) and drawable(read).all()
    assert (np.abs(np.linalg.norm(read.rotations, axis=1) - 1) < 1e-5).all()
    if ending == ".ply":
        np.testing.assert_array_equal(read.means, some.means)
    np.testing.assert_allclose(np.sort(opacities(read)), np.sort(opacities(some)), atol=BYTE)


def test_glb_says_what_its_numbers_mean(tmp_path):
    """A reader of the file by the specification of glTF and its extension alone."""
    some = splats(50, 2, antialiasing=True)
    content = written(tmp_path, ".glb", some).read_bytes()
    magic, version, length, size = struct.unpack_from("<4sIII", content)
    assert (magic, version, length) == (b"glTF", 2, len(content))
    document, binary = json.loads(content[20 : 20 + size]), content[28 + size :]
    (primitive,) = document["meshes"][0]["primitives"]
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"] and primitive["mode"] == 0
    assert set(primitive["extensions"]["KHR_gaussian_splatting"]) == {"kernel", "colorSpace"}
    prefix, values = "KHR_gaussian_splatting:", {}
    for name, index in primitive["attributes"].items():
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        assert accessor["count"] == 50 and view["byteOffset"] % 4 == 0
        if name != "COLOR_0":
            assert accessor["componentType"] == 5126
            flat = np.frombuffer(binary, "<f4", view["byteLength"] // 4, view["byteOffset"])
            values[name.removeprefix(prefix)] = flat.reshape(50, -1)
    np.testing.assert_array_equal(values["POSITION"], some.means)
    np.testing.assert_array_equal(values["ROTATION"], some.rotations[:, [1, 2, 3, 0]])
    np.testing.assert_allclose(values["SCALE"], np.exp(some.log_scales), rtol=1e-6)
    np.testing.assert_allclose(values["OPACITY"][:, 0], opacities(some), rtol=1e-6)
    names = [f"SH_DEGREE_{d}_COEF_{n}" for d in range(3) for n in range(2 * d + 1)]
    np.testing.assert_array_equal(np.stack([values[name] for name in names], axis=1), some.sh)
    assert "SH_DEGREE_3_COEF_0" not in values
    # A camera's up, -y of COLMAP, is glTF's +y once the node has turned it.
    x, y, z, w = document["nodes"][0]["rotation"]
    np.testing.assert_allclose(rotation_matrix((w, x, y, z)) @ [0, -1, 0], [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize("ending", OURS)
def test_a_full_disk_is_said_and_leaves_nothing(tmp_path, ending):
    """A limit on the size of files stands for a full disk."""
    resource = pytest.importorskip("resource", reason="there are no limits on this system")
    whole = written(tmp_path, ending, some := splats(3000, 1))
    size = whole.stat().st_size
    whole.unlink()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(0.999 * size), before[1]))
    try:
        with pytest.raises(UserError, match=f"cannot write .*model{ending}.*free space"):
            written(tmp_path, ending, some)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())


def test_usdz_has_the_schema_and_stands_upright(tmp_path):
    path = written(tmp_path, ".usdz", some := splats(20, 2))
    from pxr import Gf, Usd, UsdGeom, UsdValidation

    stage = Usd.Stage.Open(str(path))
    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
    assert [error.GetMessage() for error in context.Validate(stage)] == []
    (prim,) = [prim for prim in stage.Traverse() if prim.GetTypeName() == "ParticleField3DGaussianSplat"]
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    world = UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default())
    assert Gf.IsClose(world.TransformDir(Gf.Vec3d(0, -1, 0)), Gf.Vec3d(0, 1, 0), 1e-9)

    def value(name: str) -> np.ndarray:
        return np.asarray(prim.GetAttribute(name).Get())

    np.testing.assert_array_equal(value("positions"), some.means)
    np.testing.assert_allclose(value("scales"), np.exp(some.log_scales), rtol=1e-6)
    np.testing.assert_allclose(value("opacities"), opacities(some), rtol=1e-6)
    turn = prim.GetAttribute("orientations").Get()[3]
    np.testing.assert_array_equal([turn.GetReal(), *turn.GetImaginary()], some.rotations[3])
    assert value("radiance:sphericalHarmonicsDegree") == 2
    np.testing.assert_array_equal(value("radiance:sphericalHarmonicsCoefficients").reshape(some.sh.shape), some.sh)
    low, high = np.asarray(UsdGeom.Boundable(prim).GetExtentAttr().Get())
    assert (low < some.means).all() and (some.means < high).all()


@pytest.mark.parametrize("version", [1, 2, 3])
def test_older_spz_is_read(tmp_path, version):
    """Bytes by hand, of one splat: gzip, a part of the quaternion left out, y up; first with 16-bit floats."""
    header = struct.pack("<IIIBBBB", 0x5053474E, version, 1, 0, 12, version > 1, 0)
    position = b"".join((int(value * 4096) & 0xFFFFFF).to_bytes(3, "little") for value in (1.5, 2.0, -3.0))
    if version == 1:
        position = np.float16([1.5, 2.0, -3.0]).tobytes()
    turn = bytes([204, 127, 127]) if version < 3 else (3 << 30 | 434 << 20).to_bytes(4, "little")
    body = position + bytes([128, 255, 127, 0, 160, 80, 0]) + turn
    (tmp_path / "a.spz").write_bytes(gzip.compress(header + body))
    read = read_splats(tmp_path / "a.spz")
    np.testing.assert_allclose(read.means, [[1.5, -2.0, 3.0]])
    np.testing.assert_allclose(read.log_scales, [[0.0, -5.0, -10.0]])
    np.testing.assert_allclose(read.rotations, [[0.8, 0.6, 0, 0]], atol=0.005)
    np.testing.assert_allclose(read.sh[0, 0], [0.5 / 0.15, 0, -0.5 / 0.15], atol=0.02)
    assert read.antialiasing == (version > 1) and abs(opacities(read)[0] - 128 / 255) < 1e-6


def test_versions_of_spz_hold_the_same_and_the_oldest_has_coarser_rotations(tmp_path):
    some, read = splats(300, 2, antialiasing=True), {}
    for version in WRITTEN:
        write_spz(tmp_path / "a.spz", some, version)
        read[version] = vars(read_splats(tmp_path / "a.spz"))
    turns = [found.pop("rotations") for found in read.values()]
    for name, values in read[4].items():
        np.testing.assert_array_equal(read[3][name], values)
        np.testing.assert_array_equal(read[2][name], values)
    np.testing.assert_array_equal(turns[0], turns[1])
    assert 1 - np.abs((turns[0] * turns[2]).sum(axis=1)).min() < 2e-3  # measured 1.2e-3: w follows from three bytes


def _with_records(folder: Path, version: int, records: bytes, flags: int = 2) -> Path:
    """An SPZ of 20 splats with extension records."""
    path = folder / f"{version}.spz"
    if version == 4:
        content = bytearray(written(folder, ".spz", splats(20), "4").read_bytes())
        content[14] |= flags
        content[16:20] = (32 + len(records)).to_bytes(4, "little")
        content[32:32] = records
    else:
        content = bytearray(gzip.decompress(packed_spz(splats(20), 2)))
        content[14] |= flags
        content = gzip.compress(content + records)
    path.write_bytes(content)
    return path


TOLD = {"R": [1, 0, 0], "L": [-1, 0, 0], "D": [0, 1, 0], "U": [0, -1, 0], "F": [0, 0, 1], "B": [0, 0, -1]}


@pytest.mark.parametrize("version", [2, 4])
@pytest.mark.parametrize(
    ("number", "axes"),
    [(0, "RUB"), (4, "RUB"), (6, "RDF"), (1, "LDB"), (3, "LUB"), (8, "RUF"), (9, "LFD"), (12, "RFU"), (15, "LBU")],
)
def test_axes_that_an_spz_declares_are_its_axes(tmp_path, version, number, axes):
    """Positions, shapes and colours by direction, of the values in the file."""
    plain = half_rotated(read_splats(_with_records(tmp_path, version, b"", 0)))  # as it is in the file
    read = read_splats(_with_records(tmp_path, version, struct.pack("<III", 0xADBE0003, 4, number)))
    turn = np.array([TOLD[letter] for letter in axes]).T
    np.testing.assert_allclose(read.means, plain.means @ turn.T, atol=1e-6)
    spreads = []
    for some in (read, plain):
        axis = np.stack([rotation_matrix(wxyz) for wxyz in some.rotations.astype(float)])
        spreads.append(axis * np.exp(2 * some.log_scales)[:, None] @ axis.transpose(0, 2, 1))
    np.testing.assert_allclose(spreads[0], turn @ spreads[1] @ turn.T, atol=1e-6)
    seen = torch.nn.functional.normalize(torch.randn(9, 3, generator=torch.Generator().manual_seed(0)).double())
    shown = [
        np.einsum("dk,nkc->ndc", sh_basis(3, x).numpy(), y.sh)
        for x, y in ((seen @ torch.tensor(turn.T).double(), read), (seen, plain))
    ]
    np.testing.assert_allclose(*shown, atol=1e-5)


@pytest.mark.parametrize("version", [2, 4])
def test_other_records_of_an_spz_are_named(tmp_path, version, capsys):
    records = struct.pack("<IIf", 0xADBE0002, 4, 1.0) + struct.pack("<II3x", 0x12340001, 3)
    path = _with_records(tmp_path, version, records + struct.pack("<III", 0xADBE0003, 4, 99), 0x82)
    folder = tmp_path / "plain"
    folder.mkdir()
    means = [read_splats(file).means for file in (path, _with_records(folder, version, b"", 0))]
    np.testing.assert_array_equal(*means)
    said = f"records of {path} that are not used: 0x12340001, 0xADBE0003 (axes 99), flags 0x80\n"
    assert capsys.readouterr().err == said
    for cut in (records[:5], records[:-1]):
        with pytest.raises(UserError, match="is not a complete SPZ file"):
            read_splats(_with_records(tmp_path, version, cut))


def test_a_glb_of_more_bytes_than_its_header_can_say_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(scene_formats, "LARGEST", 1000)
    with pytest.raises(UserError, match="model.glb would have .* GB, .* leave Gaussians out by --max_splats"):
        written(tmp_path, ".glb", splats(50))
    assert not list(tmp_path.iterdir())


def test_splat_begins_with_what_matters_most(tmp_path):
    some = splats(100)
    read = read_splats(written(tmp_path, ".splat", some))
    worth = read.log_scales.sum(axis=1) + np.log(opacities(read))
    assert np.corrcoef(worth, -np.arange(100))[0, 1] > 0.9 and worth.argmax() == 0


@pytest.mark.parametrize(("antialiasing", "mode"), [(True, "mip"), (False, "default")])
def test_ply_says_axes_and_render_mode(tmp_path, antialiasing, mode):
    path = written(tmp_path, ".ply", splats(3, antialiasing=antialiasing))
    assert PlyData.read(path).comments == [
        "axes x right, y down, z forward (COLMAP)", f"SplatRenderMode: {mode}", f"antialiased {antialiasing:d}",
    ]  # fmt: skip


def test_models_and_splats_are_the_same_gaussians():
    gaussians = model(12, degree=2)
    back = splats_of(model_of(splats_of(gaussians)))
    for name, value in vars(splats_of(gaussians)).items():
        np.testing.assert_allclose(getattr(back, name), value, atol=1e-7 if name == "rotations" else 0)
    gaussians.scaling_activation = torch.nn.functional.softplus  # another activation: files still hold logarithms
    scales = np.exp(splats_of(gaussians).log_scales)
    np.testing.assert_allclose(scales, gaussians.get_scaling.detach().numpy(), rtol=1e-5)
    assert model_of(splats(4, 1), 3).active_sh_degree == 1 and model_of(splats(4, 3), 1).max_sh_degree == 1


def test_pieces_of_many_splats_are_turned_and_packed_as_all_at_once():
    rng, turn = np.random.default_rng(0), rotation_matrix((0.8, 0.4, 0.4, 0.2))
    for count, degree in ((0, 3), (1, 1), (splats_module._TOGETHER + 3, 2), (2 * splats_module._TOGETHER, 3)):
        sh = rng.normal(0, 2, (count, (degree + 1) ** 2, 3)).astype(np.float32)
        matrix = splats_module._make_sh_rotation(degree, turn).astype(np.float32)
        turned = np.einsum("jk,nkc->njc", matrix, sh.astype(np.float64))
        np.testing.assert_allclose(splats_module._rotate_sh(sh, matrix), turned, rtol=0, atol=1e-5)
        codes = np.clip(np.floor((sh[:, 1:] / np.float32(ply.SH_RANGE) + np.float32(0.5)) * 256), 0, 255)
        np.testing.assert_array_equal(
            ply._encode_rest(sh[:, 1:]), codes.swapaxes(1, 2).reshape(count, 3 * codes.shape[1])
        )


def test_selection():
    some = splats(50)
    inside = within_box(some, (-1, -1, -1, 1, 0, 1))
    assert 0 < inside.sum() < 50 and (some.means[inside][:, 1] <= 0).all()
    some.means[3, 1] = np.nan
    some.opacity_logits[4] = np.inf
    assert (~drawable(some)).nonzero()[0].tolist() == [3]
    some.rotations[5] = 0
    np.testing.assert_array_equal(tidy(some).rotations[5], [1, 0, 0, 0])
    np.testing.assert_allclose(1 / (1 + np.exp(-logits(np.float32([0, 0.5, 1]), 0.1))), [0.025, 0.5, 0.975], atol=1e-6)


def test_unknown_endings_and_files_are_refused(tmp_path):
    with pytest.raises(UserError, match=r"format of a.obj is unknown; end its name with one of mesh.ply \(surfaces"):
        find_format("a.obj")
    assert find_format("A.Compressed.PLY").ending == ".compressed.ply" and find_format("b.ply").ending == ".ply"
    assert len({entry.ending for entry in FORMATS}) == len(FORMATS)
    with pytest.raises(UserError, match="no file"):
        read_splats(tmp_path / "absent.spz")
    (tmp_path / "a.bin").write_bytes(b"hello")
    with pytest.raises(UserError, match="no model that this program reads; give PLY"):
        read_splats(tmp_path / "a.bin")


@pytest.mark.parametrize("x", [20, -1e5, 1e30])
def test_one_far_gaussian_leaves_the_others_of_a_compressed_ply(tmp_path, x):
    some, path = cube(x), written(tmp_path, ".compressed.ply", cube(x))
    read = read_splats(path)
    alone = moved(cube(), read_splats(written(tmp_path, ".compressed.ply", cube(), "alone")))
    assert len(read) == COUNT and moved(some, read).max() <= alone.max() < 0.002
    np.testing.assert_allclose(read.means[-1], some.means[FAR])
    vertex = PlyData.read(path)["vertex"].data
    assert len(vertex) % CHUNK == 1 and (vertex["packed_color"] & 255 == 0).sum() == len(vertex) - COUNT


@pytest.mark.parametrize("x", [500, -1e6, 1e30])
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
    assert said.startswith(f"warning: 1 of {COUNT} Gaussians lie more than") and "--crop drops them" in said


@pytest.mark.parametrize(("unit", "cut"), [(1, 0), (1e4, COUNT), (1e-5, COUNT)])
def test_sizes_that_spz_cannot_hold_are_told(tmp_path, capsys, unit, cut):
    """Thin axes are not, as no image shows how thin they are."""
    some = cube()
    some.log_scales[:] = np.log(0.5 * unit)
    some.log_scales[:, 1] = -20
    written(tmp_path, ".spz", replace(some, means=some.means * np.float32(unit)))
    said = capsys.readouterr().err
    assert (f"lengths from 4.5e-05 to 379 units; {cut} of {COUNT} Gaussians" in said) == (cut > 0)
    assert bool(said) == (cut > 0)


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
    said = "it holds more than its header says" if version == 3 else "stream 0 does not have its 9 by"
    with _little_memory(), pytest.raises(UserError, match=said):
        read_splats(path)


def test_a_sky_of_most_splats_does_not_coarsen_the_others_in_a_compressed_ply(tmp_path):
    rng, near, far = np.random.default_rng(0), 1000, 3000
    sky = rng.normal(size=(far, 3)) * [1, 0.3, 1] - [0, 1, 0]  # mostly on one side, as above a ground
    sky *= 500 / np.linalg.norm(sky, axis=1, keepdims=True)
    some = selected(splats(1, 0), np.zeros(near + far, int))
    sizes = np.where(np.arange(near + far) < near, -4.0, 1.5)[:, None] + rng.normal(scale=0.3, size=(near + far, 3))
    means = np.concatenate([rng.normal(size=(near, 3)), sky]).astype(np.float32)
    found = read_splats(written(tmp_path, ".compressed.ply", replace(some, means=means, log_scales=np.float32(sizes))))
    assert cKDTree(found.means).query(means[:near])[0].max() < 0.01


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize(
    ("count", "degree", "said"),
    [
        (2_000_000, 0, r"its header announces 2,000,000 rows, but the file has only [\d,]+ bytes"),
        (500, 255, "SH bands of degree 255, of at most 4"),
    ],
)
def test_spz_of_few_bytes_and_much_content_is_refused(tmp_path, version, count, degree, said):
    if version == 4:
        pytest.importorskip("zstandard", reason="the extra [export] is not installed")
    (tmp_path / "a.spz").write_bytes(empty_spz(version, count, degree))
    with _little_memory(), pytest.raises(UserError, match=f"not a complete SPZ file .{said}.*; save or download it"):
        read_splats(tmp_path / "a.spz")
