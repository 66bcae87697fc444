"""The demo: its ray tracer and COLMAP model against closed forms and pycolmap; its report, table and sheet."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from applications.demo import make_scene as maker
from applications.demo import report
from applications.demo.make_scene import make_scene
from applications.demo.tracer import CAMERAS, ring_views
from utils.system_utils import UserError

VIEWS, WIDTH, HEIGHT, POINTS = 12, 80, 60, 600


@pytest.fixture(scope="module")
def scene(once) -> Path:
    return once("demo_scene", lambda out: make_scene(out, VIEWS, WIDTH, HEIGHT, POINTS, seed=3))


@pytest.fixture(scope="module")
def model(scene):
    return pycolmap.Reconstruction(scene / "sparse" / "0")


@pytest.mark.parametrize(("camera", "size"), [("fisheye", (80, 60)), ("panorama", (80, 40))])
def test_wide_cameras_are_pycolmaps(tmp_path, camera, size):
    (view, *_) = ring_views(3, *size, np.random.default_rng(0), CAMERAS[camera])
    x, y = np.random.default_rng(1).uniform(0.02, 0.98, (2, 500)) * np.reshape(size, (2, 1))
    points = view.center[:, None] + 3 * view.rays(x, y).astype(np.float64)
    assert np.abs(np.stack(view.project(points)) - [x, y, np.full(500, 3.0)]).max() < 1e-4  # rays are float32
    theirs = pycolmap.Camera(model=view.model, width=size[0], height=size[1], params=view.params)
    local = (view.rotation @ (points - view.center[:, None])).T
    front = local[:, 2] > 0
    assert 200 < front.sum() < 450
    assert np.abs(theirs.img_from_cam(local[front]) - np.stack([x, y], 1)[front]).max() < 1e-4
    make_scene(tmp_path / "scene", VIEWS, *size, POINTS, 3, camera)
    model = pycolmap.Reconstruction(tmp_path / "scene" / "sparse" / "0")
    assert model.num_points3D() > 0.6 * POINTS
    for image in model.images.values():
        seen = [(p.xy, image.project_point(model.points3D[p.point3D_id].xyz)) for p in image.points2D]
        errors = [np.linalg.norm(xy - place) for xy, place in seen if place is not None]
        assert np.median(errors) < 1  # noise of 0.3 px, and of 0.4 % of the distance


def test_pycolmap_reads_a_valid_model(model, scene):
    assert model.is_valid()
    assert model.num_reg_images() == VIEWS
    assert 0.6 * POINTS < model.num_points3D() <= POINTS  # with so few views many points are seen by fewer than three
    camera = model.cameras[1]
    assert (camera.model_name, camera.width, camera.height) == ("PINHOLE", WIDTH, HEIGHT)
    names = sorted(image.name for image in model.images.values())
    assert names == sorted(file.name for file in (scene / "images").iterdir())
    with Image.open(scene / "images" / names[0]) as picture:
        assert picture.size == (WIDTH, HEIGHT)


def test_same_seed_same_bytes_and_another_seed_another_scene(tmp_path, monkeypatch):
    """Also by other processes."""
    folders = [tmp_path / name for name in "abc"]
    monkeypatch.setattr(maker, "PIXELS_PER_PROCESS", 24 * 18)
    for folder, seed, cores in zip(folders, (5, 5, 6), (1, 2, 1), strict=True):
        monkeypatch.setattr(maker, "cores", lambda cores=cores: cores)
        make_scene(folder, 3, 24, 18, 60, seed)
    files = sorted(file.relative_to(folders[0]) for file in folders[0].rglob("*") if file.is_file())
    first, second, other = ([(folder / file).read_bytes() for file in files] for folder in folders)
    assert len(files) >= 6 and first == second != other
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "c"]  # no temporary folder is left


@pytest.mark.parametrize(("out", "points", "said"), [
    ("", 60, "not an empty folder"),
    (".", 60, "current folder"),
    ("mine.txt/out", 60, "(cannot|cannot make the folder) .*; choose another place"),
    ("new", 1, "none of 1 points is visible in 3 views"),
])  # fmt: skip
def test_a_scene_that_cannot_be_made_changes_nothing(tmp_path, monkeypatch, out, points, said):
    (tmp_path / "mine.txt").write_text("keep")
    monkeypatch.chdir(tmp_path if out == "." else tmp_path.parent)
    with pytest.raises(UserError, match=said):
        make_scene(tmp_path / out, 3, 24, 18, points, 0)
    assert [file.name for file in tmp_path.iterdir()] == ["mine.txt"]


RESULTS = {"ours_30": {"SSIM": 0.5, "PSNR": 20.0, "LPIPS": None}}
PLY = "point_cloud/iteration_30/point_cloud.ply"
PER_VIEW = {"ours_30": {"PSNR": {"00000.png": 19.0, "00001.png": 21.0}}}


@pytest.fixture
def trained(tmp_path: Path) -> Path:
    """A model folder as train.py, render.py and metrics.py leave it."""
    folder = tmp_path / "model"
    ply = folder / PLY
    ply.parent.mkdir(parents=True)
    ply.write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 123\nend_header\n")
    for side in ("renders", "gt"):
        (folder / "test" / "ours_30" / side).mkdir(parents=True)
        for name in PER_VIEW["ours_30"]["PSNR"]:
            Image.fromarray(np.zeros((20, 30, 3), np.uint8)).save(folder / "test" / "ours_30" / side / name)
    (folder / "cfg_args").write_text("Namespace(source_path='/data/garden')")
    (folder / "results.json").write_text(json.dumps(RESULTS))
    (folder / "per_view.json").write_text(json.dumps(PER_VIEW))
    (folder / "train_log.json").write_text(json.dumps([{"iteration": 30, "seconds": 12.4, "gaussians": 123}]))
    return folder


@pytest.fixture
def reported(trained, monkeypatch) -> Callable[[], None]:
    monkeypatch.setattr("sys.argv", ["report", str(trained)])
    return report.main


@pytest.mark.filterwarnings("error::ResourceWarning")
def test_table_and_sheet(reported, trained, capsys):
    reported()
    lines = capsys.readouterr().out.splitlines()
    cells = lines[1].split()
    assert cells == ["garden", "30", "12", "s", "123", "2", "20.00", "dB", "0.5000"]
    assert lines[-2].endswith(f" {trained / 'contact_sheet.png'}") and lines[-1].endswith(f"view.py -m {trained}")
    with Image.open(trained / "contact_sheet.png") as sheet:
        assert sheet.width > 90


def test_a_damaged_log_only_costs_the_time(reported, trained, capsys):
    for text in ("{broken", '[{"iteration": 30, "seconds": "x"}]'):
        (trained / "train_log.json").write_text(text)
        reported()
        printed = capsys.readouterr()
        assert "garden" in printed.out and "12 s" not in printed.out and "train_log.json cannot be read" in printed.err


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        *((name, text, "no scores of ours_30; run render.py and metrics.py")
          for name in ("results.json", "per_view.json")
          for text in ("[]", "{", '{"ours_30": {"PSNR": {}}}', '{"ours_30": {"PSNR": "x", "SSIM": 1}}')),
        (PLY, None, "cannot read .*point_cloud.ply"),
        ("test/ours_30/gt/00001.png", None, "gt/00001.png is missing or damaged.*; run render.py"),
        ("test/ours_30/gt/00001.png", "x", "gt/00001.png is missing or damaged.*; run render.py"),
    ],
)  # fmt: skip
def test_missing_and_damaged_files_are_named(reported, trained, name, text, sentence):
    (trained / name).unlink() if text is None else (trained / name).write_text(text)
    with pytest.raises(UserError, match=sentence):
        reported()
    assert not (trained / "contact_sheet.png").exists()
