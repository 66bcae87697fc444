"""Models of other tools: PLYs of any form, as the start of a training and in render.py; what is refused."""

import gzip
import json
import re
import sys
from collections import OrderedDict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from gaussians import options
from PIL import Image
from plyfile import PlyData, PlyElement
from small_splats import splats, written

import export
import render
import train
from applications.export.formats import find_format
from applications.export.importance import most_needed
from applications.export.reading import read_any
from gaussian_renderer.camera_paths.keyframes import CameraPath, Keyframe
from gaussian_renderer.scored_views import ScoredViews
from scene.gaussian_model import GaussianModel
from scene.gaussians.checkpoint import save_checkpoint
from scene.gaussians.ply import read_ply
from scene.readers.point_cloud import read_point_cloud
from scene.saved_model import find_save, load_saved, read_model
from scene.splats.reading import is_point_cloud, read_splats
from scene.splats.splats import Splats, selected
from scene.with_splats import model_of, splats_of
from utils.sh_utils import C0
from utils.system_utils import UserError


def _foreign_ply(path: Path, count: int, kind: str) -> Path:
    """A PLY as another program might write it, of splats(count, 1)."""
    find_format("a.ply").write(path, splats(count, 1))
    data = PlyData.read(path, mmap=False)["vertex"].data
    names = [name for name in data.dtype.names if name not in ("nx", "ny", "nz")]
    if kind == "2DGS":
        names.remove("scale_2")
    if kind == "points":
        names = ["x", "y", "z"]
    form = [(name, "f4") for name in names]
    more = [("red", "u1"), ("green", "u1"), ("blue", "u1")] if kind == "points" else [("segment", "i4")]
    foreign = np.zeros(count, dtype=[*more, *form])
    for name in names:
        foreign[name] = data[name]
    PlyData([PlyElement.describe(foreign, "vertex")], text=False).write(str(path))
    return path


def test_what_is_no_3dgs_model_is_refused_by_name(tmp_path):
    flat, points = (_foreign_ply(tmp_path / f"{kind}.ply", 5, kind) for kind in ("2DGS", "points"))
    with pytest.raises(UserError, match=r"flat Gaussians of two scales \(2DGS\).*give a 3DGS model"):
        read_splats(flat)
    with pytest.raises(UserError, match="start a training from this point cloud with train.py --init_pcd_path"):
        read_splats(points)
    assert is_point_cloud(points) and not is_point_cloud(flat)
    packed = tmp_path / "b.compressed.ply"
    find_format(packed).write(packed, splats(5))
    assert not is_point_cloud(packed)
    with pytest.raises(UserError, match=r"is a compressed PLY; unpack it with export.py --ply .*b.compressed.ply"):
        read_ply(packed, 3)
    said = {"a.sog": "is a SOG; give a PLY of it, by export.py .*a.sog --to", "a.glb": "is no model that this program"}
    for name, words in said.items():
        (tmp_path / name).write_bytes(b"PK")
        assert not is_point_cloud(tmp_path / name)
        with pytest.raises(UserError, match=f"{name} {words}"):
            read_splats(tmp_path / name)
    plain = tmp_path / "c.ply"
    export.export(*_export_options("--ply", packed, "--to", plain))
    assert read_ply(plain, 3, further=False)["xyz"].shape == (5, 3)


def _export_options(*argv: object) -> tuple:
    parser, model_params, pipeline_params = export.options()
    args = export.parse(parser, [str(word) for word in argv])
    return args, model_params.extract(args), pipeline_params.extract(args)


def _train(scene: Path, out: Path, *argv: object) -> GaussianModel:
    train.main(["-s", str(scene), "-m", str(out), "--iterations", "1", "--no_curve", "--keep_unseen",
                "--prune_sh", "-1", *map(str, argv)])  # fmt: skip
    return read_model(out / "point_cloud/iteration_1/point_cloud.ply")


def _by_place(splats: Splats) -> Splats:
    """In an order that does not depend on the one they came in."""
    return selected(splats, np.lexsort(splats.means.T))


@pytest.mark.parametrize(("ending", "degree"), [(".ply", 1), (".splat", 3), (".spz", 3)])
def test_training_starts_from_the_gaussians_of_a_file(tmp_path, colmap_scene, ending, degree):
    """The last iteration takes no step, so one iteration saves the start; bands above the model's are left out."""
    path = written(tmp_path, ending, splats(30, 2))
    started = _by_place(splats_of(_train(colmap_scene, tmp_path / "out", "--init_ply", path, "--sh_degree", degree)))
    for name, values in vars(_by_place(splats_of(model_of(read_splats(path), degree)))).items():
        np.testing.assert_allclose(getattr(started, name), values, rtol=0, atol=1e-6)
    assert len(read_point_cloud(tmp_path / "out/input.ply").points) == 30


def _checkpoint(path: Path, some: Splats, kind: str) -> Path:
    """Write splats in the form that another program's trainer saves."""
    values = {name: torch.from_numpy(x) for name, x in vars(some).items() if isinstance(x, np.ndarray)}
    sh, logits = values["sh"], values["opacity_logits"]
    named = {"means": values["means"], "scales": values["log_scales"], "quats": values["rotations"]}
    if kind == "gsplat":
        splats = torch.nn.ParameterDict(named | {"opacities": logits, "sh0": sh[:, :1], "shN": sh[:, 1:]})
        torch.save({"step": 9, "splats": splats.state_dict()}, path)
    elif kind == "nerfstudio":
        first = sh[:, 0] if sh.shape[1] > 1 else torch.logit(sh[:, 0] * C0 + 0.5)
        named |= {"opacities": logits[:, None], "features_dc": first, "features_rest": sh[:, 1:]}
        state = {f"_model.gauss_params.{name}": x for name, x in named.items()} | {"_model.device": torch.empty(0)}
        torch.save({"step": 9, "pipeline": OrderedDict(state), "optimizers": {}, "scalers": {"scale": 1.0}}, path)
    else:
        gaussians = model_of(some)
        gaussians.training_setup(options())
        save_checkpoint(path, gaussians.capture(), 9)
    return path


@pytest.mark.parametrize("degree", [0, 2])
@pytest.mark.parametrize("kind", ["gsplat", "nerfstudio", "train.py"])
def test_checkpoints_are_models(tmp_path, kind, degree, capsys):
    some = splats(30, degree)
    path = _checkpoint(
        tmp_path / {"gsplat": "a_rank0.pt", "nerfstudio": "a.ckpt", "train.py": "a.pth"}[kind], some, kind
    )
    assert not is_point_cloud(path)
    read = read_any(path)
    for name, values in vars(some).items():
        np.testing.assert_allclose(getattr(read, name), values, rtol=0, atol=1e-5)
    assert (f"{path} is of {kind}: it fits the cameras" in capsys.readouterr().err) == (kind != "train.py")


def test_parts_of_a_checkpoint_and_other_checkpoints_are_told(tmp_path, capsys):
    for rank in range(2):
        path = _checkpoint(tmp_path / f"ckpt_6_rank{rank}.pt", splats(5), "gsplat")
    read_splats(path)
    said = "warning: .*_rank1.pt has a part of the Gaussians; all are in ckpt_6_rank0.pt to ckpt_6_rank1.pt"
    assert re.search(said, capsys.readouterr().err)
    values = torch.load(path)["splats"]
    torch.save({"splats": values | {"shN": torch.zeros(5, 24, 3)}}, tmp_path / "e.pt")
    assert read_splats(tmp_path / "e.pt").sh_degree == 3
    assert "e.pt are left out; models have at most degree 3" in capsys.readouterr().err
    for content in ({"model": torch.zeros(3)}, {"splats": {"means": torch.zeros(3, 3)}}, torch.zeros(4), [1, 2]):
        torch.save(content, tmp_path / "a.pt")
        with pytest.raises(UserError, match="is a checkpoint without Gaussians of gsplat or nerfstudio; export"):
            read_splats(tmp_path / "a.pt")
    torch.save({"splats": Path("a")}, tmp_path / "b.ckpt")
    (tmp_path / "c.pt").write_text("words")
    for name in ("b.ckpt", "c.pt"):
        with pytest.raises(UserError, match="is not a checkpoint that can be read .*; export a PLY with the program"):
            read_splats(tmp_path / name)
    torch.save({"model": 1}, tmp_path / "d.pth")
    with pytest.raises(UserError, match="d.pth is not a checkpoint of train.py"):
        read_any(tmp_path / "d.pth")


@pytest.mark.parametrize("kind", ["ply", "checkpoint"])
def test_a_start_relative_to_a_world_offset_is_moved_back(tmp_path, colmap_scene, kind):
    start = replace(splats(30, 0), world_offset=(1.0, -2.0, 3.0))
    if kind == "ply":
        path = written(tmp_path, ".ply", start)
    else:
        path = _checkpoint(tmp_path / "chkpnt9.pth", start, "train.py")
        (tmp_path / "model.json").write_text(json.dumps({"world_offset": start.world_offset}))
    means = _by_place(splats_of(_train(colmap_scene, tmp_path / "out", "--init_ply", path))).means
    np.testing.assert_allclose(means, _by_place(start).means + [1.0, -2.0, 3.0], rtol=0, atol=1e-6)


def test_an_exported_model_keeps_its_world_offset(tmp_path, colmap_scene):
    gaussians = _train(colmap_scene, tmp_path / "out")
    gaussians.world_offset = (1.0, -2.0, 3.0)
    gaussians.save_ply(tmp_path / "out/point_cloud/iteration_1/point_cloud.ply")
    remembered = json.loads((tmp_path / "out/model.json").read_text()) | {"world_offset": [1.0, -2.0, 3.0]}
    (tmp_path / "out/model.json").write_text(json.dumps(remembered))
    for number, words in enumerate(([], ["--max_splats", 10**6])):  # without its scene, and with it
        path = tmp_path / f"{number}.compressed.ply"
        export.export(*_export_options("-m", tmp_path / "out", "--to", path, *words))
        assert read_splats(path).world_offset == (1.0, -2.0, 3.0)
        export.export(*_export_options("--ply", path, "--to", tmp_path / "again.ply"))
        assert read_splats(tmp_path / "again.ply").world_offset == (1.0, -2.0, 3.0)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("--init_pcd_path b.ply", "--init_ply a.ply"),
        ("--init_type random", "--init_ply a.ply"),
        ("--init_type random", "--init_pcd_path a.ply"),
    ],
)
def test_two_starts_contradict_each_other(one, other):
    with pytest.raises(UserError, match=f"^{one} and {other} both name"):
        train.parse(["-s", "x", *other.split(), *one.split()])


def test_render_draws_a_file_in_the_views_of_a_scene(tmp_path, colmap_scene, monkeypatch):
    path = tmp_path / "theirs.compressed.ply"
    find_format(path).write(path, splats(200, 1, antialiasing=True))
    out = tmp_path / "out"
    argv = ["render.py", "-s", colmap_scene, "-m", out, "--eval", "--ply", path, "--skip_train"]
    monkeypatch.setattr("sys.argv", [str(word) for word in argv])
    render.main()
    pictures = sorted((out / "test/ours_theirs/renders").iterdir())
    assert len(pictures) == 3 and not (out / "train").exists()
    assert '"antialiasing": true' in (out / "test/ours_theirs/render_times.json").read_text()


@pytest.mark.parametrize("trained", [True, False])
def test_only_a_model_is_said_to_be_trained_without_eval(tmp_path, colmap_scene, monkeypatch, capsys, trained):
    path, out = tmp_path / "theirs.ply", tmp_path / "out"
    find_format(path).write(path, splats(20, 1))
    if trained:
        _train(colmap_scene, out, "--init_ply", path)
    words = {"the model was trained without --eval": [], "--eval holds some out": ["--ply", path]}
    for said, more in words.items():
        if more or trained:
            argv = ["render.py", "-s", colmap_scene, "-m", out, "--skip_train", *more]
            monkeypatch.setattr("sys.argv", [str(word) for word in argv])
            render.main()
            assert f"test: no views; {said} [" in capsys.readouterr().out


def test_export_chooses_what_it_writes(tmp_path, colmap_scene, capsys):
    out = tmp_path / "out"
    start = tmp_path / "start.ply"
    find_format(start).write(start, splats(300, 3))
    _train(colmap_scene, out, "--init_ply", start)
    capsys.readouterr()
    target = tmp_path / "few.ply"
    box = ["--crop", -1, -1, -1, 1, 1, 1]
    export.export(*_export_options("-m", out, "--to", target, *box, "--min_opacity", 0.3, "--sh_degree", 1))
    read, every = read_splats(target), read_splats(find_save(str(out), -1)[1])
    expected = (np.abs(every.means) <= 1).all(axis=1) & (1 / (1 + np.exp(-every.opacity_logits)) >= 0.3)
    np.testing.assert_allclose(read.means, every.means[expected], atol=1e-6)
    assert read.sh_degree == 1 and 10 < len(read) < 200
    assert re.search(rf"Wrote .*few.ply: {len(read)} of 300 Gaussians, SH degree 1, 0.0\d MB", capsys.readouterr().out)
    args = _export_options("-m", out, "--to", target, "--max_splats", 100, "--min_opacity", 0.3)
    export.export(*args)
    said = capsys.readouterr().out
    count, *decibels = re.search(r"(\d+) -> 100 Gaussians: training views (\S+) -> (\S+) dB", said).groups()
    before, after = map(float, decibels)
    scene = load_saved(args[1], -1)
    opaque = scene.gaussians.get_opacity[:, 0] >= 0.3
    assert int(count) == opaque.sum() > 100
    part = scene.gaussians.part(opaque, 3)
    views = ScoredViews(args[2], torch.zeros(3), False)
    best = part.part(most_needed(part, scene.getTrainCameras(), views, 100), 3)
    np.testing.assert_allclose(read_splats(target).means, best.get_xyz.detach().numpy())
    assert after > 0 and abs(before - after) < 20
    for path, at in ((start, start), (None, out / "input.ply"), (None, find_save(str(out), -1)[1])):
        before = Path(at).read_bytes()
        words = ("--ply", path) if path else ("-m", out)
        with pytest.raises(UserError, match="would overwrite a trained model or its input; choose another file"):
            export.export(*_export_options(*words, "--to", at))
        assert Path(at).read_bytes() == before
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(UserError, match="folder.ply is a folder; give the name of a file"):
        export.export(*_export_options("-m", out, "--to", tmp_path / "folder.ply"))
    for _ in range(2):  # an earlier export in the model's folder is replaced
        export.export(*_export_options("-m", out, "--to", out / "model.ply"))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--ply a.ply --min_opacity 2", "--min_opacity must be from 0 to 1, got 2.0"),
        ("--ply a.ply --max_splats -1", "--max_splats must be above 0"),
        (
            f"--ply a.ply --to b.html --notes {Path(__file__).with_name('pyramid_60.json')}",
            "pyramid_60.json is no plain text; write it as docs/guide/w",
        ),
        ("--ply a.ply --crop 1 0 0 0 1 1", "--crop takes the smaller corner first"),
        ("--ply a.ply --max_splats 5", "need training views"),
        ("--ply absent.ply", "no file absent.ply; give a model as PLY"),
        ("--ply .", ". is a folder; give the file of a model in it"),
        ("", "no model folder given"),
        ("--ply a.ply --to b.splat --path ellipse", "--path is for .html; leave it out, or end --to with .html"),
        ("--ply a.ply --to b.html --path elipse", "--path must be interpolate, ellipse, spiral or a file"),
        ("--ply a.ply --to b.html", "no file a.ply"),
        ("--ply a.ply --to b.spz --to c.ply --to b.spz", "--to b.spz is given twice; give each file once"),
        ("--ply a.ply --to b.ply --spz_version 3", "--spz_version is for .spz; leave it out, or end --to with .spz"),
        ("--ply a.ply --to b.spz --to c.plx", "the format of c.plx is unknown"),
        ("--ply a.ply --to b.html --to mesh.ply", "meshes need training views"),
    ],
)
def test_export_refuses(words, said):
    to = () if "--to" in words else ("--to", "b.ply")
    with pytest.raises(UserError, match=said):
        export.export(*_export_options(*to, *words.split()))


def test_a_page_plays_the_camera_path(tmp_path, colmap_scene):
    _train(colmap_scene, tmp_path / "out")
    first = Keyframe(0.0, (0.0, 0.0, -3.0), (1.0, 0.0, 0.0, 0.0), 40.0)
    last = replace(first, seconds=7.0, position=(1.0, 0.0, -3.0), fov=50.0)
    CameraPath((first, last)).write(path := tmp_path / "tour.json")
    export.export(*_export_options("-m", tmp_path / "out", "--to", tmp_path / "page.HTML", "--raw", "--path", path))
    text = re.search(r'id="page">(.*?)</script>', (tmp_path / "page.HTML").read_text(encoding="utf-8"))[1]
    (track,) = json.loads(text)["settings"]["animTracks"]
    fov = track["keyframes"]["values"]["fov"]
    assert track["duration"] == 7 and (fov[0], fov[-1]) == (40, 50)


def test_older_versions_of_spz_need_no_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "zstandard", None)
    words = "--ply", written(tmp_path, ".ply", splats(20)), "--to", tmp_path / "a.spz", "--spz_version"
    for version in (3, 2):
        export.export(*_export_options(*words, version))
        assert gzip.decompress((tmp_path / "a.spz").read_bytes())[4] == version
    with pytest.raises(UserError, match="needs the package zstandard"):
        export.export(*_export_options(*words, 4))


@pytest.mark.parametrize(("ending", "module"), [(".spz", "zstandard"), (".usdz", "pxr"), (".sog", None)])
def test_what_a_format_needs_is_looked_for_before_the_model_is_loaded(tmp_path, monkeypatch, ending, module):
    if module:
        monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setattr("shutil.which", lambda *_, **__: None)
    monkeypatch.setattr(export, "load", lambda *_, **__: pytest.fail("the model was loaded"))
    with pytest.raises(UserError, match="needs .*; install"):
        export.export(*_export_options("--ply", tmp_path / "a.ply", "--to", tmp_path / f"model{ending}"))


@pytest.mark.parametrize("change", [lambda photos: photos, lambda photos: photos[::-1], np.zeros_like])
def test_a_model_that_was_moved_is_told_of_by_its_renders(tmp_path, capsys, change):
    photos = np.random.default_rng(0).integers(0, 255, (8, 48, 64, 3)).astype(np.uint8)
    for side, pictures in (("renders", change(photos) // 2), ("gt", photos)):
        (tmp_path / side).mkdir()
        for index, picture in enumerate(pictures):
            Image.fromarray(picture).save(tmp_path / side / f"{index:05d}.png")
    render.warn_if_elsewhere("a.ply", tmp_path)
    said = capsys.readouterr().err
    assert said == "" if change(photos) is photos else "a.ply may not be where the cameras are" in said
