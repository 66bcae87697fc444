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
from applications.demo.objects import Ground, Shape, Sphere, Torus, demo_scene
from applications.demo.tracer import CAMERAS, ring_views
from splatting.records.renders import GAIN, GAP, HEADER, contact_sheet
from utils.system_utils import UserError

VIEWS, WIDTH, HEIGHT, POINTS = 12, 80, 60, 600


@pytest.fixture(scope="module")
def scene(once) -> Path:
    return once("demo_scene", lambda out: make_scene(out, VIEWS, WIDTH, HEIGHT, POINTS, seed=3))


@pytest.fixture(scope="module")
def model(scene):
    return pycolmap.Reconstruction(scene / "sparse" / "0")


def rays(count: int, center: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Origins (3, R) around a centre and unit directions (3, R) towards points near it, float64."""
    rng = np.random.default_rng(11)
    origin = rng.normal(size=(3, count))
    origin = np.asarray(center)[:, None] + 3 * origin / np.linalg.norm(origin, axis=0)
    direction = np.asarray(center)[:, None] + rng.uniform(-0.7, 0.7, (3, count)) - origin
    return origin, direction / np.linalg.norm(direction, axis=0)


def inside(shape: Shape, p: np.ndarray) -> np.ndarray:
    """The depth of points (3, N) in a solid, positive inside; float64, independent of the tracer."""
    offset = p - np.reshape(getattr(shape, "center", (0, 0, 0)), (3, 1))
    if isinstance(shape, Ground):
        return p[1]
    if isinstance(shape, Sphere):
        depth = shape.radius - np.linalg.norm(offset, axis=0)
        return -depth if shape.inside else depth
    if isinstance(shape, Torus):
        axis = np.asarray(shape.axis) / np.linalg.norm(shape.axis)
        height = axis @ offset
        ring = np.linalg.norm(offset - axis[:, None] * height, axis=0)
        return shape.tube - np.hypot(ring - shape.radius, height)
    c, s = np.cos(shape.turn), np.sin(shape.turn)
    local = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) @ offset
    return (np.reshape(shape.half, (3, 1)) - np.abs(local)).min(axis=0)


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


def test_tracks_are_what_is_visible(model):
    """Nothing is between a camera and a point that it observes; something is in front of other points in the frame.

    The scene's points are noisy, so both hold for nearly all of them.
    """
    things = demo_scene()
    part = np.linspace(0.05, 0.97, 120)
    blocked = {True: [], False: []}
    for image in model.images.values():
        center = image.projection_center()[:, None]
        seen = {point2d.point3D_id for point2d in image.points2D}
        for point_id, point in model.points3D.items():
            place = image.project_point(point.xyz)
            if place is None or not (1 < place[0] < WIDTH - 1 and 1 < place[1] < HEIGHT - 1):
                continue
            line = center + part * (point.xyz[:, None] - center)
            depth = max(inside(thing.shape, line).max() for thing in things)
            blocked[point_id in seen].append(depth > 0.03)
    assert len(blocked[True]) > 2000 and len(blocked[False]) > 100
    assert np.mean(blocked[True]) < 0.02
    assert np.mean(blocked[False]) > 0.8


def test_same_seed_same_bytes_and_another_seed_another_scene(tmp_path):
    folders = [tmp_path / name for name in "abc"]
    for folder, seed in zip(folders, (5, 5, 6), strict=True):
        make_scene(folder, 3, 24, 18, 60, seed)
    files = sorted(file.relative_to(folders[0]) for file in folders[0].rglob("*") if file.is_file())
    assert len(files) >= 6
    contents = [[(folder / file).read_bytes() for file in files] for folder in folders]
    assert contents[0] == contents[1]
    assert contents[0] != contents[2]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "c"]  # no temporary folder is left


def test_other_processes_give_the_same_pictures(monkeypatch):
    views = ring_views(4, 24, 18, np.random.default_rng(0))
    alone = maker._images(views, maker._demo, 2)
    monkeypatch.setattr(maker, "PIXELS_PER_PROCESS", 24 * 18)
    monkeypatch.setattr(maker, "cores", lambda: 2)
    assert np.array_equal(maker._images(views, maker._demo, 2), alone)


@pytest.mark.parametrize(
    ("out", "points", "said"),
    [
        ("", 60, "not an empty folder"),
        (".", 60, "current folder"),
        ("mine.txt/out", 60, "(cannot|cannot make the folder) .*; choose another place"),
        ("new", 1, "none of 1 points is visible in 3 views"),
    ],
)
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


@pytest.mark.parametrize("text", ["{broken", '[{"iteration": 30, "seconds": "x"}]'])
def test_a_damaged_log_only_costs_the_time(reported, trained, capsys, text):
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


def test_contact_sheet_shows_truth_render_and_amplified_error():
    truth = Image.new("RGB", (140, 30), (100, 100, 100))
    render = Image.new("RGB", (140, 30), (110, 90, 100))
    sheet = contact_sheet([("a", truth, render), ("b", truth, truth)])
    assert sheet.size == (3 * (140 + GAP) + GAP, HEADER + 2 * (30 + GAP))
    bottom = HEADER + 29  # below the label
    assert sheet.getpixel((GAP + 139, bottom)) == (100, 100, 100)
    assert sheet.getpixel((2 * GAP + 140 + 139, bottom)) == (110, 90, 100)
    assert sheet.getpixel((3 * GAP + 280 + 139, bottom)) == (10 * GAIN, 10 * GAIN, 0)
    assert sheet.getpixel((3 * GAP + 280 + 139, bottom + 30 + GAP)) == (0, 0, 0)
