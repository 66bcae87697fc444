"""point_cloud.ply: the reference's layout byte for byte, files of other writers, clear messages."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from gaussians import FURTHER, model, options, parameters
from plyfile import PlyData, PlyElement

from scene.gaussian_model import GaussianModel
from scene.gaussians.attributes import attributes
from scene.gaussians.checkpoint import save_checkpoint
from scene.readers.point_cloud import read_point_cloud
from scene.saved_model import read_model
from scene.splats.reading import is_point_cloud, read_splats
from scene.splats.splats import drawable
from utils.system_utils import UserError

ORDER = (
    ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    + [f"f_rest_{i}" for i in range(45)]
    + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    + [column for name in FURTHER for column in attributes(0)[name].columns]
)


def _assert_equal(a: GaussianModel, b: GaussianModel) -> None:
    for name, value in parameters(a).items():
        assert torch.equal(parameters(b)[name], value), name


def _loaded(path, degree: int = 3) -> GaussianModel:
    gaussians = GaussianModel(degree)
    gaussians.load_ply(path)
    return gaussians


def test_layout_by_plyfile(tmp_path):
    gaussians = model(17)
    gaussians.save_ply(tmp_path / "a" / "point_cloud.ply")
    content = PlyData.read(tmp_path / "a" / "point_cloud.ply")
    assert not content.text and content.byte_order == "<" and [e.name for e in content.elements] == ["vertex"]
    vertex = content["vertex"]
    assert [p.name for p in vertex.properties] == ORDER
    assert {p.val_dtype for p in vertex.properties} == {"f4"}
    rest = gaussians._features_rest.detach().numpy()
    for channel in range(3):
        for k in range(15):
            np.testing.assert_array_equal(vertex[f"f_rest_{channel * 15 + k}"], rest[:, k, channel])
    for name, tensor in {"x": gaussians._xyz[:, 0], "nz": torch.zeros(17), "f_dc_2": gaussians._features_dc[:, 0, 2],
                         "opacity": gaussians._opacity[:, 0], "scale_1": gaussians._scaling[:, 1],
                         "rot_3": gaussians._rotation[:, 3]}.items():  # fmt: skip
        np.testing.assert_array_equal(vertex[name], tensor.detach().numpy())


@pytest.mark.parametrize(("count", "degree"), [(9, 0), (9, 1), (9, 2), (9, 3), (0, 1)])
def test_round_trip(tmp_path, count, degree):
    gaussians = model(count, degree) if count else GaussianModel(degree)
    gaussians.save_ply(tmp_path / "a.ply")
    again = _loaded(tmp_path / "a.ply", degree)
    _assert_equal(gaussians, again)
    assert len(again) == count and again.active_sh_degree == degree
    again.save_ply(tmp_path / "b.ply")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_a_model_of_others_keeps_its_bytes(shared_dir, tmp_path):
    source = shared_dir / "models" / "room7k_sh3.ply"
    gaussians = _loaded(source)
    assert len(gaussians) == 9080
    gaussians.save_ply(tmp_path / "again.ply")
    assert (tmp_path / "again.ply").read_bytes() == source.read_bytes()


@pytest.mark.parametrize("kind", ["shuffled", "text", "big endian", "double", "extra", "no normals"])
def test_foreign_files_load(tmp_path, kind):
    gaussians = model(11)
    gaussians.save_ply(tmp_path / "ours.ply")
    data = PlyData.read(tmp_path / "ours.ply", mmap=False)["vertex"].data
    names = list(data.dtype.names)
    if kind == "shuffled":
        names = list(np.random.default_rng(0).permutation(names))
    if kind == "no normals":
        names = [name for name in names if name[0] != "n"]
    kinds = dict.fromkeys(names, "f8" if kind == "double" else "f4")
    if kind == "extra":
        kinds = {"id": "u1", **kinds, "label": "i4"}
    foreign = np.zeros(len(data), dtype=list(kinds.items()))
    for name in names:
        foreign[name] = data[name]
    PlyData(
        [PlyElement.describe(foreign, "vertex")], text=kind == "text", byte_order=">" if kind == "big endian" else "<"
    ).write(tmp_path / "foreign.ply")
    _assert_equal(gaussians, _loaded(tmp_path / "foreign.ply"))


def _rewritten(source: Path, target: Path, rename: Callable[[str], str], **more: np.ndarray) -> None:
    data = PlyData.read(source, mmap=False)["vertex"].data
    names = [rename(name) for name in data.dtype.names]
    columns = [(name, "f4") for name in (*names, *more) if name]
    foreign = np.zeros(len(data), dtype=columns)
    for name, old in zip(names, data.dtype.names, strict=True):
        if name:
            foreign[name] = data[old]
    for name, values in more.items():
        foreign[name] = values
    PlyData([PlyElement.describe(foreign, "vertex")]).write(target)


def test_bands_above_degree_3_are_left_out(tmp_path, capsys):
    gaussians, degree, each = model(4), 4, 24
    gaussians.save_ply(tmp_path / "a.ply")

    def place(name: str) -> str:
        number = int(name.removeprefix("f_rest_")) if name.startswith("f_rest_") else None
        return name if number is None else f"f_rest_{number // 15 * each + number % 15}"

    taken = {place(f"f_rest_{i}") for i in range(45)}
    more = {name: np.full(4, 9) for i in range(3 * each) if (name := f"f_rest_{i}") not in taken}
    _rewritten(tmp_path / "a.ply", tmp_path / "b.ply", place, **more)
    capsys.readouterr()
    _assert_equal(gaussians, _loaded(tmp_path / "b.ply"))
    assert f"SH bands of degree {degree} are left out; models have at most degree 3" in capsys.readouterr().err
    np.testing.assert_array_equal(read_splats(tmp_path / "b.ply").sh, gaussians.get_features.detach().numpy())


def _with(folder: Path, **columns: object) -> Path:
    """The PLY of a model of ten Gaussians with other columns, or further ones; None: without one."""
    model(10).save_ply(folder / "a.ply")
    more = {name: values for name, values in columns.items() if values is not None}
    _rewritten(folder / "a.ply", folder / "b.ply", lambda name: "" if name in columns else name, **more)
    return folder / "b.ply"


@pytest.mark.parametrize("load", [read_model, read_splats, _loaded])
def test_the_filter_of_mip_splatting_is_applied(tmp_path, capsys, load):
    """Its paper: variances grow by the filter's, and opacities fall with the square root of the determinant."""
    widths, alone = np.linspace(0, 2, 10, dtype=np.float32), model(10)
    found = load(_with(tmp_path, filter_3D=widths))
    names = ("_opacity", "_scaling") if isinstance(found, GaussianModel) else ("opacity_logits", "log_scales")
    logits, scales = (torch.as_tensor(getattr(found, name)).detach().double() for name in names)
    before = alone._scaling.detach().double().exp() ** 2
    after = before + torch.as_tensor(widths).double()[:, None] ** 2
    torch.testing.assert_close(scales.exp(), after.sqrt(), rtol=1e-5, atol=0)
    opacity = alone._opacity.detach().double().sigmoid()[:, 0] * (before.prod(1) / after.prod(1)).sqrt()
    torch.testing.assert_close(logits.flatten().sigmoid(), opacity, rtol=1e-4, atol=0)
    said = capsys.readouterr().err
    assert "3D filter of Mip-Splatting (filter_3D), which is applied" in said and "not used" not in said


LOGITS, SIZES = np.linspace(0.01, 0.99, 10), np.linspace(0.004, 0.05, 10)


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        ({}, ""),
        ({name: 200 for name in ("red", "green", "blue", "alpha")}, ""),
        (
            {"trbf_center": 0.5, "motion_0": 1, "motion_1": 2, "motion_2": 3},
            r"columns of \S+b.ply that are not used: motion_0, motion_1, motion_2 and 1 more\n"
            r"warning: \S+b.ply is a model that moves, of which only one state is drawn.*\n",
        ),
        ({"segment": 4}, r"columns of \S+b.ply that are not used: segment\n"),
        (
            {"opacity": LOGITS},
            "warning: all opacities of .* are from 0.01 to 0.99, so they may be no logits;.*\n",
        ),
        ({"opacity": 255 * LOGITS}, "warning: all opacities of .* are from 2.55 to 252, so they may be no logits.*\n"),
        ({"opacity": 8 * LOGITS - 1}, ""),
        (
            {f"f_dc_{i}": LOGITS for i in range(3)},
            "warning: all colours of .* are from 0.01 to 0.99, so they may be no SH coefficients; export.*\n",
        ),
        (
            {f"scale_{i}": SIZES for i in range(3)},
            "warning: all scales of .* are above 0, so they may be no logarithms; export.*\n",
        ),
        ({**{f"scale_{i}": SIZES for i in range(3)}, "x": 10_000 * LOGITS}, ""),  # of a scene in small units
    ],
)
def test_what_a_foreign_file_may_mean_is_told_once(tmp_path, capsys, columns, said):
    path = _with(tmp_path, **columns)
    capsys.readouterr()
    for _ in range(2):
        read_model(path)
    assert re.fullmatch(said, capsys.readouterr().err)


def test_other_elements_and_lists_are_named(tmp_path, capsys):
    points = np.zeros(2, [(name, "O" if name == "opacity" else "f4") for name in ORDER])
    others = [PlyElement.describe(np.zeros(1, [("x", "f4")]), name) for name in ("face", "delta_vertex_0")]
    points["opacity"] = [np.zeros(2, "f4")] * 2
    PlyData([PlyElement.describe(points, "vertex")]).write(tmp_path / "lists.ply")
    with pytest.raises(UserError, match="it lacks the properties opacity; give"):
        read_model(tmp_path / "lists.ply")
    path = _with(tmp_path)
    PlyData([PlyData.read(path)["vertex"], *others]).write(tmp_path / "c.ply")
    read_model(tmp_path / "c.ply")
    said = capsys.readouterr().err
    assert "elements of" in said and "not used: delta_vertex_0\n" in said and "a model that moves" in said


INCOMPLETE = "SH coefficients f_rest of .* are incomplete: {}; export the model again"
COLORS = {name: 255 for name in ("red", "green", "blue")} | dict.fromkeys(("f_dc_0", "f_dc_1", "f_dc_2"))


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        ({"f_rest_44": None}, INCOMPLETE.format("44 of 45, without f_rest_44")),
        ({"f_rest_7": None, "f_rest_999": 1}, INCOMPLETE.format("44 of 45, without f_rest_7")),
        ({"f_rest_45": 1}, INCOMPLETE.format("46 of 72, without f_rest_46")),
        ({f"f_rest_{i}": None for i in range(1, 45)}, INCOMPLETE.format("1 of 9, without f_rest_1")),
        (COLORS, "as red, green, blue instead of f_dc_0, f_dc_1, f_dc_2; export the model again"),
    ],
)
def test_columns_that_are_no_model_are_refused(tmp_path, columns, said):
    with pytest.raises(UserError, match=said):
        read_model(_with(tmp_path, **columns))


def test_names_of_cloudcompare(tmp_path):
    gaussians = model(4)
    gaussians.save_ply(tmp_path / "a.ply")
    _rewritten(tmp_path / "a.ply", tmp_path / "b.ply", lambda name: name if name[0] in "xyz" else f"scalar_{name}")
    _assert_equal(gaussians, _loaded(tmp_path / "b.ply"))
    assert not is_point_cloud(tmp_path / "b.ply")


def test_scales_of_0_are_tiny_however_they_are_loaded(tmp_path, capsys):
    gaussians = model(6)
    with torch.no_grad():
        gaussians._scaling[2, 1], gaussians._scaling[3] = -torch.inf, -torch.inf
    gaussians.save_ply(tmp_path / "a.ply")
    gaussians.training_setup(options())
    save_checkpoint(tmp_path / "a.pth", gaussians.capture(), 1)
    for path in (tmp_path / "a.ply", tmp_path / "a.pth"):
        scales = read_model(path)._scaling
        assert (scales[2, 1], scales[3, 0]) == (-80, -80) and scales.isfinite().all()
        assert scales[2, 0] == gaussians._scaling[2, 0]
    assert drawable(read_splats(tmp_path / "a.ply")).all() and capsys.readouterr().err == ""


def test_bands_that_the_file_lacks_are_zero(tmp_path):
    """The last save leaves out bands that are zero: a program that wants degree 3 gets the same model."""
    for degree in (0, 1, 2):
        gaussians = model(5, degree=degree)
        gaussians.save_ply(tmp_path / "low.ply")
        again = _loaded(tmp_path / "low.ply", 3)
        count = (degree + 1) ** 2
        assert again.active_sh_degree == 3 and again._features_rest.shape == (5, 15, 3)
        torch.testing.assert_close(again.get_features[:, :count], gaussians.get_features, rtol=0, atol=0)
        assert not again.get_features[:, count:].any()


def test_refusals(tmp_path):
    model(5, degree=2).save_ply(tmp_path / "two.ply")
    with pytest.raises(UserError, match="SH degree 2.*SH degree 1 needs 9.*--sh_degree"):
        _loaded(tmp_path / "two.ply", 1)
    points = np.zeros(4, dtype=[(name, "f4") for name in "xyz"])
    PlyData([PlyElement.describe(points, "vertex")]).write(tmp_path / "points.ply")
    with pytest.raises(UserError, match="f_dc_0, f_dc_1, f_dc_2, opacity, scale_0.*rot_3"):
        _loaded(tmp_path / "points.ply")
    PlyData([PlyElement.describe(points, "corner")]).write(tmp_path / "corner.ply")
    with pytest.raises(UserError, match="vertex"):
        _loaded(tmp_path / "corner.ply")
    with pytest.raises(UserError, match="no file"):
        _loaded(tmp_path / "absent.ply")
    (tmp_path / "text.ply").write_text("hello")
    with pytest.raises(UserError, match="not a complete PLY"):
        _loaded(tmp_path / "text.ply")
    whole = (tmp_path / "two.ply").read_bytes()
    for length in (len(whole) - 7, len(whole) // 2, 40, 0):
        (tmp_path / "cut.ply").write_bytes(whole[:length])
        with pytest.raises(UserError, match="not a complete PLY"):
            _loaded(tmp_path / "cut.ply", 2)


JUNK = "element junk 1000000000000\nproperty {}\n"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        *((" 100000000000", f" {count}") for count in ("1" + "0" * 40, "+4_000_000_000", "9" * 500)),
        ("\n", "\r\n"),
        ("ply\n", "ply\ncomment end_header\n"),
        ("element vertex", "element\vvertex"),
        ("element vertex 1", JUNK.format("double q") + "element vertex 1"),
        ("end_header", JUNK.format("list uchar int q") + "end_header"),
        ("element vertex 1", "element junk -1000000000000\nproperty int q\nelement vertex 100000000000"),
    ],
)
def test_rows_are_counted_however_the_header_is_written(tmp_path, old, new):
    header, path = "ply\nformat ascii 1.0\nelement vertex 1\nproperty double x\nend_header\n", tmp_path / "a.ply"
    many = header if "junk" in new else header.replace("vertex 1", "vertex 100000000000")
    path.write_bytes((many.replace(old, new) + "0\n").encode())
    for read in (_loaded, read_point_cloud):
        with pytest.raises(UserError, match=r" (vertices|rows of \w+) announced, file ends after [\d,]+ bytes\)"):
            read(path)


def test_gaussians_that_are_not_drawn_are_told_of(tmp_path, capsys):
    gaussians = model(6)
    with torch.no_grad():
        gaussians._xyz[1, 2] = torch.nan
        gaussians._scaling[4, 0] = torch.inf
        gaussians._opacity[5] = torch.inf  # an opacity of 1
    gaussians.save_ply(tmp_path / "point_cloud.ply")
    capsys.readouterr()
    _loaded(tmp_path / "point_cloud.ply")
    said = capsys.readouterr().err
    assert "warning: 2 of 6 Gaussians in" in said and "are not finite, and are not drawn" in said
    assert drawable(read_splats(tmp_path / "point_cloud.ply")).tolist() == [True, False, True, True, False, True]


@pytest.mark.parametrize(
    ("encoding", "line"),
    [("utf-8", "\tcomment 漢字"), ("latin-1", "obj_info Straße "), ("utf-8-sig", ""), ("utf-16", "  comment Größe")],
)
def test_a_header_may_have_any_letters_and_blanks(tmp_path, encoding, line):
    gaussians, path = model(3), tmp_path / "a.ply"
    gaussians.save_ply(path)
    PlyData(PlyData.read(path, mmap=False), text=encoding == "utf-16", byte_order="<").write(path)
    old, new = ("\nelement", f"\n{line}\nelement")
    if encoding == "utf-16":
        path.write_bytes(path.read_bytes().decode().replace(old, new, 1).encode(encoding))
    else:
        mark = b"\xef\xbb\xbf" if encoding == "utf-8-sig" else b""
        encoded = new.encode(encoding.removesuffix("-sig"), "replace")
        path.write_bytes(mark + path.read_bytes().replace(old.encode(), encoded, 1))
    _assert_equal(gaussians, _loaded(path))
    assert not is_point_cloud(path) and len(read_splats(path)) == len(read_point_cloud(path).points) == 3


def test_a_header_without_an_end_is_refused_at_once(tmp_path, monkeypatch):
    """plyfile would take minutes and a gigabyte."""
    (tmp_path / "endless.ply").write_bytes(b"ply\nformat ascii 1.0\ncomment " + b"x" * (2 << 20) + b"\nend_header\n")
    monkeypatch.setattr(PlyData, "read", lambda *_: pytest.fail("plyfile was asked"))
    with pytest.raises(UserError, match="no end_header in its first MiB"):
        _loaded(tmp_path / "endless.ply")
    with pytest.raises(UserError, match="no end_header in its first MiB"):
        read_point_cloud(tmp_path / "endless.ply")


def test_the_filter_of_mip_splatting_on_extreme_gaussians(tmp_path):
    """Variances of 3e-26 have a product that no float32 holds."""
    logits = np.array([5, -5, 90, -90, np.inf, -np.inf, 0, 5, 0, -5], np.float32)
    widths = np.array([1] * 7 + [0] * 3, np.float32)
    sizes = {f"scale_{i}": np.float32(-29.4) for i in range(3)}
    found = read_model(_with(tmp_path, opacity=logits, filter_3D=widths, **sizes))
    # A faint opacity's logarithm is its logit: that of before, and -29.4 for each axis.
    faint = -np.logaddexp(0, -logits.astype(float)) - 3 * 29.4
    np.testing.assert_allclose(found._opacity.detach().numpy()[:, 0], np.where(widths, faint, logits), rtol=1e-6)
    np.testing.assert_allclose(found._scaling.detach().numpy()[:, 0], np.where(widths, 0, -29.4), rtol=1e-6, atol=1e-6)
