"""doctor.py: each fault gets its own line; an intact scene and model get none."""

import argparse
import dataclasses
import json
import re
import shutil
from pathlib import Path

import diff_gaussian_rasterization
import numpy as np
import pytest
import simple_knn
import torch
from gaussians import pipeline
from PIL import Image
from synthetic import HEIGHT, WIDTH, edit_json

import applications.doctor.model
import doctor
from applications.doctor import environment
from applications.doctor.model import check_model
from arguments import ModelParams, read_cfg_args, write_cfg_args, write_model_json
from benchmarks.scenes.poses import disturb_poses
from gaussian_renderer import render
from groundwork.finding import Finding, fine
from scene.checks.cameras import check_cameras, check_extent
from scene.checks.points import check_points
from scene.checks.scene import check_dataset
from scene.dataset_readers import read_scene
from scene.gaussian_model import GaussianModel
from scene.saved_model import load_saved
from utils.graphics_utils import BasicPointCloud
from utils.system_utils import UserError


def problems(lines: list[Finding]) -> list[str]:
    return [line.line for line in lines if line.is_problem]


@pytest.fixture
def healthy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate an environment without problems, whatever is installed."""
    monkeypatch.setattr(environment, "check_packages", lambda: [fine("packages")])
    monkeypatch.setattr(environment, "check_build", lambda: [fine("build")])


def exit_status(*argv: str) -> int:
    try:
        doctor.main(argv)
    except SystemExit as end:
        return end.code
    return 0


def test_exit_statuses(healthy, colmap_scene, capsys):
    assert exit_status() == 0
    assert exit_status("-s", str(colmap_scene)) == 1
    out = capsys.readouterr().out
    assert "PROBLEM only 17 photos -> " in out and "PROBLEM only 300 points" in out and out.endswith("2 problems\n")
    for option, folder in (("-s", "nowhere"), ("-m", "")):
        with pytest.raises(UserError, match=f"no folder .*{folder}.*; pass an existing folder as {option}"):
            doctor.main([option, folder])
    with pytest.raises(UserError, match="--masks names mask files of a scene; give the scene as -s"):
        doctor.main(["--masks", "masks"])
    assert exit_status("-s", str(colmap_scene), "-m", "nowhere") == 1
    assert "no model in nowhere yet" in capsys.readouterr().out


def test_extensions_that_do_not_fit(monkeypatch, tmp_path):
    """The extension simple-knn, against a repository with the Python part that is installed."""
    package = tmp_path / "submodules" / "simple-knn" / "simple_knn"
    shutil.copytree(Path(simple_knn.__file__).parent, package, ignore=shutil.ignore_patterns("*.so", "__pycache__"))
    versions = {"gaussian-splatting": "0.1.0+cu13"}  # all three in one

    def check(version: str = "0.1.0") -> str:
        (tmp_path / "version.txt").write_text(f"{version}\n")
        return environment._check_extension("simple-knn").line

    monkeypatch.setattr(environment, "ROOT", tmp_path)
    monkeypatch.setattr(environment, "_read_version", versions.get)
    assert check() == "ok      extension simple-knn 0.1.0+cu13"
    (package / "ops.py").write_text("changed")
    assert "installed from other sources than these (ops.py) -> run `pip install ./submodules/simple-knn`" in check()
    assert "is version 0.1.0+cu13, but this code is 0.2.0" in check("0.2.0")
    versions.clear()
    assert "PROBLEM the extension simple-knn is not installed" in check()


def test_the_rasterizer_is_tried(monkeypatch):
    assert not environment._check_rasterizer(torch).is_problem
    right = diff_gaussian_rasterization.rasterize
    wrong = lambda **k: (drawn := right(**k))._replace(color=drawn.color + 1e-4)  # noqa: E731
    monkeypatch.setattr(diff_gaussian_rasterization, "rasterize", wrong)
    line = environment._check_rasterizer(torch)
    assert line.is_problem and "differs from its float64 oracle by 1.0e-04" in line.text


def test_a_gpu_that_is_too_old(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "V100")
    for capability, served in (((7, 0), False), ((7, 5), True), ((12, 0), True)):
        monkeypatch.setattr(torch.cuda, "get_device_capability", lambda capability=capability: capability)
        assert environment._check_gpu(torch).is_problem != served


@pytest.fixture
def info(colmap_scene):
    """The synthetic scene: cameras around a unit cube of points, all facing it."""
    return read_scene(colmap_scene, "images", hold_out=False)


def _with_cameras(info, change, extent: float | None = None):
    """The scene with changed cameras. change(index, camera): the fields to replace."""
    cameras = [dataclasses.replace(camera, **change(i, camera)) for i, camera in enumerate(info.train_cameras)]
    radius = {"radius": info.extent if extent is None else extent}
    return dataclasses.replace(info, train_cameras=cameras, nerf_normalization=radius)


def test_cameras_that_stand_or_look_oddly(info):
    for factor, remedy in ((1e-7, "by 1e+07"), (1e7, "by 1e-07")):
        scaled = _with_cameras(info, lambda _, camera, f=factor: {"T": camera.T * f}, info.extent * factor)
        assert remedy in problems(check_extent(scaled))[0]
    name = info.train_cameras[3].image_name
    (line,) = _said(check_cameras(_with_cameras(info, lambda i, c: {"T": c.T + 200 * (i == 3)}, 50.0)))
    assert f"1 of 17 cameras are more than 10 times as far from the middle as the median camera ({name})" in line
    (line,) = _said(check_cameras(_with_cameras(info, lambda _, c: {"T": -c.R.T @ np.ones(3)})))
    assert "all cameras stand in one place" in line


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda pose: pose, ""),
        (np.linalg.inv, "all cameras stand in one place, so depth cannot be found; check the scale, and whether poses"),
        (
            lambda pose: pose * [1, -1, -1, 1],
            "the cameras stand around a place and look away from it; check the scale,",
        ),
    ],
)
def test_poses_of_another_form_without_points(blender_scene, change, text):
    for file in blender_scene.glob("transforms_*.json"):
        edit_json(file, lambda content: [f.update(transform_matrix=change(np.array(f["transform_matrix"])).tolist())
                                         for f in content["frames"]])  # fmt: skip
    found = read_scene(blender_scene, "images", hold_out=False)
    said = [*_said(check_cameras(found)), *problems(check_extent(found))]
    assert [line[: len(text)] for line in said] == [text] * bool(text)


def _said(found) -> list[str]:
    return [str(one) for one in found]


def _with_cloud(info, points: np.ndarray):
    return dataclasses.replace(info, point_cloud=BasicPointCloud(points, np.zeros_like(points), np.zeros_like(points)))


def test_points_and_cameras_that_do_not_meet(info):
    many = np.random.default_rng(0).normal(scale=0.2, size=(2000, 3)).astype(np.float32)
    assert _said(check_points(_with_cloud(info, many))) == []
    half_turn = np.diag([-1.0, 1.0, -1.0])
    turned = lambda camera: {"R": camera.R @ half_turn, "T": half_turn @ camera.T}  # noqa: E731
    away = _with_cloud(_with_cameras(info, lambda _, camera: turned(camera)), many)
    assert (
        "100% of the points are in no photo: poses and points do not belong together; check the scale, and "
        in (_said(check_points(away))[0])
    )
    assert _said(check_points(dataclasses.replace(away, has_random_points=True))) == []
    few = _with_cloud(_with_cameras(info, lambda i, camera: turned(camera) if i % 4 == 0 else {}), many)
    assert "hardly any point is in view of 5 cameras" in (line := _said(check_points(few))[0]) and "remove" not in line
    one = _with_cloud(_with_cameras(info, lambda i, camera: {} if i else turned(camera)), many)
    name = info.train_cameras[0].image_name
    assert f"hardly any point is in view of 1 camera ({name})" in _said(check_points(one))[0]
    far = many.copy()
    far[::20] = 1e5
    assert "5.0% of the points are more than 100 extents away" in _said(check_points(_with_cloud(info, far)))[0]


def test_what_readers_say_becomes_a_line(colmap_scene, tmp_path):
    (picture, *_) = sorted((colmap_scene / "images" / "left").iterdir())
    Image.new("RGB", (96, 70)).save(picture)
    first = check_dataset(str(colmap_scene), "images")[0].line
    assert first.startswith("note    1 of 17 photos do not have the aspect ratio of their camera")
    picture.unlink()
    (line,) = check_dataset(str(colmap_scene), "images")
    assert line.is_problem and "are missing" in line.text and "-i" in line.remedy


def test_poses_that_tracks_correct(colmap_scene, tmp_path):
    """Turned and moved, with points and photos as they are. No better pose is near one that is far from the model's."""
    for number, (degrees, percent, said) in enumerate([(0, 0, ""), (0.3, 0.5, "better poses"), (9, 20, "3 degrees")]):
        folder = disturb_poses(colmap_scene, tmp_path / str(number), degrees, percent, 1)
        lines = [line for line in problems(check_dataset(str(folder), "images")) if "from where photos show" in line]
        assert len(lines) == bool(said) and said in "".join(lines)
        if "better" in said:
            given, best = map(float, re.findall(r"[\d.e-]+(?= pixels| with better)", lines[0]))
            assert 0.2 < given < 5 and best < 0.01 and "--refine_poses" in lines[0]


def test_what_convert_noted(colmap_scene):
    advice = ["13 of 30 photos were left out; take more photos between them"]
    report = {"registered": 17, "photos": 30, "advice": advice}
    path = colmap_scene / "convert_report.json"
    path.write_text(json.dumps(report))
    said = problems(check_dataset(str(colmap_scene), "images"))
    assert "PROBLEM only 17 of 30 photos were placed by convert.py -> take more photos between them" in said
    path.write_text("{")
    assert "convert_report.json is damaged" in str(problems(check_dataset(str(colmap_scene), "images")))
    path.write_text(json.dumps(report | {"unusable": "the camera turned, so do not train; walk"}))
    verdict = "PROBLEM convert.py says of this scene: the camera turned, so do not train"
    assert problems(check_dataset(str(colmap_scene), "images"))[0].startswith(verdict)
    (colmap_scene / "sparse" / "0" / "points3D.bin").write_bytes(bytes(8))  # none
    assert problems(check_dataset(str(colmap_scene), "images")) == [f"{verdict} -> walk"]


@pytest.fixture
def model(colmap_scene, tmp_path):
    """A function that writes a model of the synthetic scene with changed Gaussians and returns the folder."""

    def write(
        change=lambda _: None, iteration: int = 7, source: Path = colmap_scene, cloud: Path = colmap_scene
    ) -> str:
        folder = tmp_path / "model"
        given = argparse.Namespace(source_path=str(source), model_path=str(folder))
        write_cfg_args(folder, ModelParams(argparse.ArgumentParser()).extract(given))
        gaussians = GaussianModel(3)
        points = read_scene(cloud, "images", hold_out=False).point_cloud
        gaussians.create_from_pcd(points, [], 1.0)
        with torch.no_grad():
            change(gaussians)
        gaussians.save_ply(folder / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply")
        return str(folder)

    return write


def filled(**columns: float):
    """A change that fills columns of the Gaussians."""
    return lambda gaussians: [getattr(gaussians, f"_{name}").fill_(value) for name, value in columns.items()]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda gaussians: gaussians._scaling[5, 1].fill_(np.nan),
         "1 of 300 Gaussians have a scale that is not finite -> resume from an earlier checkpoint"),
        (filled(opacity=-7), "renders of the training views are black -> the dataset has problems (only 17 photos): "),
        (filled(opacity=3, features_dc=-5), "renders of the training views are black -> "),
        (lambda gaussians: gaussians._xyz.add_(500), "renders of the training views are black -> "),
    ],
)  # fmt: skip
def test_models_with_a_fault(model, change, said):
    found = problems(check_model(model(change, iteration=2000), -1))
    assert any(said in text for text in found)
    assert not any("train longer" in text for text in found)


@pytest.mark.slow
def test_a_model_is_checked_against_the_scene_that_is_given(healthy, model, colmap_scene, tmp_path, capsys):
    moved = colmap_scene.rename(tmp_path / "moved")
    folder = model(source=tmp_path / "gone", cloud=moved)
    lines = check_model(folder, -1, str(moved))
    assert lines[0].text == "iteration 7, 300 Gaussians of SH degree 3" and "renders" not in lines[0].text
    exit_status("-s", str(moved), "-m", folder)
    out = capsys.readouterr().out
    assert "no scene folder" not in out and "iteration 7, 300 Gaussians" in out
    (moved / "images").rename(moved / "pictures")
    assert "has its photos" in problems(check_model(folder, -1, str(moved)))[0]
    assert not any("has its photos" in text for text in problems(check_model(folder, -1, str(moved), "pictures")))


def _photograph(folder: Path, change, **options) -> None:
    """Let the photos of a model's scene be its own renders on black, after change(pixels) to them, (H, W, 3) uint8."""
    stored = _options(folder)
    scene = load_saved(stored, -1)
    for camera in scene.getTrainCameras():
        with torch.no_grad():
            image = render(camera, scene.gaussians, pipeline(), torch.zeros(3), **options)["render"].clamp(0, 1)
        pixels = (image.permute(1, 2, 0) * 255).round().to(torch.uint8).numpy().copy()
        Image.fromarray(change(pixels)).save(Path(stored.source_path) / "images" / camera.image_name)


def _options(folder: Path, **changed) -> argparse.Namespace:
    """A model's options; changed ones are stored."""
    options = ModelParams(argparse.ArgumentParser()).extract(argparse.Namespace(**read_cfg_args(folder) | changed))
    if changed:
        write_cfg_args(folder, options)
    return options


def _mask(scene: Path, mask: np.ndarray) -> None:
    """Give all photos of a scene a mask (H, W) uint8."""
    for camera in read_scene(scene, "images", hold_out=False).train_cameras:
        path = scene / "masks" / camera.image_name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(mask).save(path)


@pytest.mark.slow
def test_models_that_have_not_converged(model, monkeypatch):
    lines = check_model(model(), -1)
    assert lines[1].text.startswith("opacities: median 0.10; sizes: median ")
    assert any("PSNR of only" in text and "train longer, 3000 iterations" in text for text in problems(lines))
    late = model(iteration=20000)
    assert "dB -> the dataset has problems (only 17 photos)" in str(problems(check_model(late, -1)))
    monkeypatch.setattr(applications.doctor.model, "check_dataset", lambda *_: [])
    assert "dB -> check the poses (x right, y down, z forward)" in str(problems(check_model(late, -1)))


@pytest.mark.parametrize("halves", [False, True])
def test_only_what_is_scored_is_looked_at(model, colmap_scene, monkeypatch, halves):
    """Photos whose right halves are a model's own renders, and whose left halves are nonsense."""
    monkeypatch.setattr(applications.doctor.model, "_WIDTH", WIDTH)
    folder = Path(model(filled(opacity=3)))
    if halves:
        _options(folder, train_test_exp=True)
        names = [camera.image_name for camera in read_scene(colmap_scene, "images", hold_out=False).train_cameras]
        brighter = [[0.5, 0.0, 0.0, 0.3], [0.0, 0.5, 0.0, 0.3], [0.0, 0.0, 0.5, 0.3]]
        (folder / "exposure.json").write_text(json.dumps(dict.fromkeys(names, brighter)))
    right = np.arange(WIDTH) >= WIDTH // 2
    _photograph(folder, lambda x: np.where(right[:, None], x, 255 - x), use_trained_exp=halves)
    _mask(colmap_scene, np.where(right, 255, 0).astype(np.uint8)[None].repeat(HEIGHT, axis=0))
    if not halves:
        assert any("PSNR of only" in text for text in problems(check_model(str(folder), -1)))
        write_model_json(folder, argparse.Namespace(masks="masks"), antialiasing=False, seed=0)
    lines = check_model(str(folder), -1)
    assert problems(lines) == []
    assert float(re.search(r"PSNR (\S+) dB", lines[-1].text)[1]) > 50  # the photos are rounded to 8 bits
    if not halves:
        write_model_json(folder, argparse.Namespace(masks="masks", invert_masks=True), antialiasing=False, seed=0)
        assert any("PSNR of only" in text for text in problems(check_model(str(folder), -1)))


def test_folders_that_are_no_models(model, tmp_path):
    assert "no cfg_args" in check_model(str(tmp_path), -1)[0].text
    folder = Path(model())
    assert "iteration 8 was never saved" in check_model(str(folder), 8)[0].text
    ply = folder / "point_cloud" / "iteration_7" / "point_cloud.ply"
    ply.write_bytes(ply.read_bytes()[:-100])
    assert "is not a complete PLY file" in check_model(str(folder), -1)[0].text
    assert "no scene folder" in check_model(model(source=tmp_path / "gone"), -1)[0].text
