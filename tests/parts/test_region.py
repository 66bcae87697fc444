"""Regions (--region): which pixels see them, what the loss weighs, and trainings and exports with them."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from synthetic import make_colmap_scene
from trainings import train_on

import export
from benchmarks.scenes import region as benchmark
from scene.splats.reading import read_splats
from splatting.parts.region.part import OUTSIDE, VALID, Region, problem
from splatting.parts.region.shape import Box, Sphere, found, restored
from utils.system_utils import UserError, run_cli

SHAPES = [
    Sphere([0.3, -0.2, 4.0], 1.0),
    Sphere([0.0, 0.0, 0.2], 1.0),  # the camera is inside
    Sphere([0.0, 0.0, -4.0], 1.0),  # behind it
    Box([-1.0, -0.5, 3.0], [0.4, 0.6, 4.0]),
    Box([-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]),
    Box([-1.0, -1.0, -3.0], [1.0, 1.0, -2.0]),
]


def _view(turned: bool) -> SimpleNamespace:
    """A camera at the origin, or one that is turned and elsewhere; principal point off the middle."""
    R, T = np.eye(3), np.zeros(3)
    if turned:
        R, _ = np.linalg.qr(np.eye(3) + 0.3 * np.random.default_rng(1).normal(size=(3, 3)))
        R *= np.sign(np.diagonal(R))
        T = np.array([0.2, -0.1, 0.5])
    size = {"image_width": 48, "image_height": 32, "fx": 40.0, "fy": 44.0, "cx": 25.0, "cy": 14.0}
    return SimpleNamespace(R=R, T=T, device=torch.device("cpu"), **size)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_a_pixel_sees_a_region_where_its_ray_meets_it(shape, turned):
    view = _view(turned)
    x, y = np.meshgrid(np.arange(48) + 0.5, np.arange(32) + 0.5)
    local = np.stack([(x - view.cx) / view.fx, (y - view.cy) / view.fy, np.ones_like(x)], -1)
    depths = np.linspace(0.001, 8, 4000)
    seen = shape.seen(view)[0].numpy()
    differ = 0
    for row, column in np.ndindex(8, 12):
        at = 4 * row, 4 * column
        points = (depths[:, None] * local[at] - view.T) @ view.R.T
        differ += shape.holds(torch.from_numpy(points)).any().item() != seen[at]
    assert differ <= 1  # a ray that grazes it between two depths


def test_pixels_outside_weigh_a_tenth_and_all_one_in_the_mean():
    part, views = Region(), [_view(False), _view(True)]
    scene = SimpleNamespace(info=SimpleNamespace(train_cameras=[], offset=np.zeros(3)), getTrainCameras=lambda: views)
    part.begin(SimpleNamespace(opt=SimpleNamespace(region="0.3 -0.2 4 1"), scene=scene), None)
    gradients, inside = [], [SHAPES[0].seen(view) for view in views]
    for view in views:
        image = torch.rand(3, 32, 48, requires_grad=True)
        render = 1 * image
        (term,) = part.terms(SimpleNamespace(camera=view)).values()
        (render.sum() + term({"render": render}, None)).backward()
        gradients.append(image.grad)
    gradients, inside = torch.stack(gradients), torch.stack(inside).expand(-1, 3, -1, -1)
    assert 20 < inside[0, 0].sum() < 800 and gradients.mean() == pytest.approx(1, rel=1e-5)
    assert torch.allclose(gradients[~inside], OUTSIDE * gradients[inside].mean(), rtol=1e-5)
    assert torch.allclose(gradients[inside], gradients[inside].mean(), rtol=1e-5)


@pytest.mark.parametrize(("text", "seen_by"), [("0 0 -4 1", "no pixel"), ("0 0 0.2 1", "all pixels")])
def test_a_region_that_changes_nothing_is_refused(text, seen_by):
    scene = SimpleNamespace(
        info=SimpleNamespace(train_cameras=[], offset=np.zeros(3)), getTrainCameras=lambda: [_view(False)]
    )
    with pytest.raises(UserError, match=f"{seen_by} of the training photos would see --region"):
        Region().begin(SimpleNamespace(opt=SimpleNamespace(region=text), scene=scene), None)


def test_numbers_are_in_the_coordinates_of_the_scene():
    sphere, box = (restored(numbers, [1, 2, 3]).facts() for numbers in ([1, 2, 3, 0.5], [1, 2, 3, 2, 4, 6]))
    assert sphere == [0, 0, 0, 0.5] and box == [0, 0, 0, 1, 2, 3]


@pytest.mark.parametrize("text", ["1 2 3", "0 0 0 -1", "0 0 0 1 1 -1", "0 0 0 nan", "middle", "1 2 3 4 5"])
def test_other_regions_are_refused(text):
    assert problem(text) == VALID


@pytest.mark.parametrize("text", ["", "auto", "0 0 0 2", "-1,-1,-1,1,1,2.5"])
def test_regions_are_spheres_or_boxes(text):
    assert problem(text) is None


def test_auto_is_a_sphere_around_what_the_cameras_look_at(capsys):
    turn, away = Rotation.from_euler("y", [[0], [40], [80]], degrees=True).as_matrix(), np.array([0, 0, -4])
    views = [SimpleNamespace(native=None, R=r, center=r @ away + [1, 2, 3]) for r in turn]
    info = SimpleNamespace(train_cameras=views, offset=np.array([10.0, 0, 0]))
    assert found(None, SimpleNamespace(info=info)).facts()[:3] == pytest.approx([1, 2, 3])
    assert '--region auto takes the sphere "11 2 3 ' in capsys.readouterr().out
    info.train_cameras = views[:1]
    with pytest.raises(UserError, match="finds no point that the cameras look at"):
        found(None, SimpleNamespace(info=info))


def test_a_training_keeps_its_region_for_exports(tmp_path, monkeypatch, capsys):
    scene = tmp_path / "scene"
    make_colmap_scene(scene)
    model, quick = tmp_path / "model", ("-r", 48, "--iterations", 20, "--no_curve", "--quiet", "--disable_viewer")
    train_on(scene, model, "--region", "0.8 0 0 0.7", *quick)
    whole = read_splats(str(next((model / "point_cloud").glob("*/point_cloud.ply"))))
    out = tmp_path / "part.ply"
    monkeypatch.setattr(sys, "argv", ["export.py", "-m", str(model), "--to", str(out), "--only_region"])
    export.main()
    inside = restored([0.8, 0, 0, 0.7]).holds(torch.from_numpy(whole.means))
    assert 0 < len(read_splats(str(out))) == int(inside.sum()) < len(whole)
    bare = tmp_path / "bare"
    train_on(scene, bare, *quick)
    monkeypatch.setattr(sys, "argv", ["export.py", "-m", str(bare), "--to", str(out), "--only_region"])
    with pytest.raises(SystemExit):
        run_cli(export.main)
    assert "--only_region needs a model folder (-m) that was trained with --region" in capsys.readouterr().err


def test_both_parts_of_a_picture_make_its_psnr(colmap_scene, tmp_path, monkeypatch, capsys):
    error, mask = torch.rand(3, 8, 9), torch.rand(1, 8, 9) < 0.3
    squares = [10 ** (-benchmark._psnr(error, part) / 10) * 3 * int(part.sum()) for part in (mask, ~mask)]
    assert sum(squares) == pytest.approx(error.sum().item(), rel=1e-5) and benchmark._psnr(error, mask & ~mask) is None
    train_on(colmap_scene, tmp_path / "model", "--eval", "-r", 2, "--iterations", 2, "--no_curve", "--disable_viewer")
    monkeypatch.setattr(sys, "argv", ["region", str(tmp_path / "model"), "--region", "0 0 0 0.5"])
    benchmark.main()
    row = [cell.strip() for cell in capsys.readouterr().out.splitlines()[-1].split("|")]
    assert float(row[2]) > 0 and float(row[3]) > 0 and row[5].endswith("of 300")
