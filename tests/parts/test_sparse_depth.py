"""Depth by the points of structure from motion (--sparse_depth): where they lie, their loss, and trainings with it."""

from operator import itemgetter
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from synthetic import BROWN, make_colmap_scene, options_of
from trainings import trained

import metrics
import render
from groundwork.files.image_files import read_plane
from groundwork.files.json_files import read_json
from scene.gaussian_model import GaussianModel
from scene.point_depths import HELD_OUT, PointDepths, points_of
from scene.readers.tracks import read_tracks
from scene.scene import Scene

FISHEYE = (*BROWN[:4], 0.02, -0.01, 0.003, 0.001)


def _scene(folder: Path, **more) -> Scene:
    return Scene(options_of(folder, folder / "out", eval=True, **more), GaussianModel(1), start=False)


@pytest.mark.parametrize("lenses", ["native", "undistort"])
@pytest.mark.parametrize(("model", "params"), [("PINHOLE", BROWN[:4]), ("OPENCV", BROWN), ("OPENCV_FISHEYE", FISHEYE)])
def test_points_lie_where_pycolmap_shows_them(model, params, lenses, tmp_path):
    """At half the size, with depths as the renderer has them."""
    known = make_colmap_scene(tmp_path, model=model, params=params)
    scene = _scene(tmp_path, lenses=lenses)
    views = scene.info.train_cameras
    tracks = read_tracks(tmp_path, views, scene.info.offset)
    ranks = {point: rank for rank, point in enumerate(sorted(known.points3D))}
    images = {image.name: image for image in known.images.values()}
    for camera in scene.getTrainCameras():
        view, image = views[camera.uid], images[camera.image_name]
        small = camera.at_size((camera.image_width // 2, camera.image_height // 2))
        found = points_of(small, view, tracks[camera.uid])
        assert (found.weights * found.inverse_depths).sum() == pytest.approx(1, rel=1e-5)
        wanted: dict[int, set[float]] = {}
        for two in image.points2D:
            if not two.has_point3D() or ranks[two.point3D_id] % HELD_OUT == 0:
                continue
            seen = image.cam_from_world() * known.points3D[two.point3D_id].xyz
            x, y = two.xy * (small.image_width / 96, small.image_height / 64)
            if camera.lens is None:
                x, y = seen[0] / seen[2] * small.fx + small.cx, seen[1] / seen[2] * small.fy + small.cy
            far = np.linalg.norm(seen) if camera.lens and camera.lens.chart == "equidistant" else seen[2]
            if 0 <= x < small.image_width and 0 <= y < small.image_height:
                wanted.setdefault(int(y) * small.image_width + int(x), set()).add(1 / far)
        pixels = found.pixels.tolist()
        assert len(set(pixels)) == len(pixels) > 60
        assert len(set(pixels) ^ set(wanted)) <= 2  # on the border of two pixels
        shown = [(p, d) for p, d in zip(pixels, found.inverse_depths.tolist(), strict=True) if p in wanted]
        assert all(min(abs(d / other - 1) for other in wanted[p]) < 1e-5 for p, d in shown)


def test_the_gradient_is_that_of_finite_differences_and_masks_count():
    points = PointDepths(torch.tensor([1, 3, 5]), torch.tensor([0.5, 0.2, 0.4]), torch.tensor([1.0, 2.0, 3.0]))
    depth = torch.tensor([[[0.1, 0.7, 0.3], [0.1, 0.9, 0.8]]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(points.loss, depth)
    assert points.loss(depth).item() == pytest.approx(0.2 + 2 * 0.1 + 3 * 0.4)
    mask = torch.tensor([[[True, False, True], [True, True, True]]])
    assert points.loss(depth, mask).item() == pytest.approx(2 * 0.1 + 3 * 0.4)


@pytest.fixture(scope="module")
def scene(_colmap_master: Path) -> Path:
    return _colmap_master


def _scores(scene: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    """Return the scores of metrics.py for the test views' depth."""
    monkeypatch.setattr("sys.argv", ["render.py", "-m", str(folder), "--skip_train", "--depth", "--quiet"])
    render.main()
    monkeypatch.setenv("GS_DOWNLOAD", "0")
    metrics.evaluate([folder])
    return read_json(folder / "results.json")["ours_60"]


def _by_pycolmap(scene: Path, folder: Path) -> list[list[float]]:
    """Relative errors of each test view at its held-out points, from the files that render.py has written."""
    known, errors = pycolmap.Reconstruction(str(scene / "sparse/0")), []
    judging = [point for rank, point in enumerate(sorted(known.points3D)) if rank % HELD_OUT == 0]
    for place, image in enumerate(sorted(known.images.values(), key=lambda image: image.name)[::8]):
        plane = read_plane(folder / f"test/ours_60/depth/{place:05d}.png")
        found: dict[tuple[int, int], list[float]] = {}
        for two in image.points2D:
            if two.has_point3D() and two.point3D_id in judging:
                x, y = (int(value * plane.shape[0] / 64) for value in two.xy)
                point = known.points3D[two.point3D_id]
                trust = (point.track.length() - 1) / (1 + point.error**2)
                depth = (image.cam_from_world() * point.xyz)[2]
                found.setdefault((x, y), []).append((-trust, abs(plane[y, x] * depth - 1)))
        errors.append([min(of_pixel, key=itemgetter(0))[1] for of_pixel in found.values()])
    return errors


def test_depth_comes_nearer_to_points_of_test_views(scene, tmp_path, monkeypatch):
    """They are scored by render.py and metrics.py, as pycolmap says."""
    found = {}
    for name, options in (("without", ()), ("with", ("--sparse_depth", 1.0))):
        trained(scene, tmp_path / name, *options, "--test_iterations", -1, "--opacity_reset_interval", 3000)
        found[name] = _scores(scene, tmp_path / name, monkeypatch)
    assert found["with"]["DEPTH"] < 0.9 * found["without"]["DEPTH"]
    errors = _by_pycolmap(scene, tmp_path / "with")
    for key, share in (("DEPTH", 0.5), ("DEPTH_95", 0.95)):
        expected = np.mean([np.quantile(of_view, share) for of_view in errors])
        assert found["with"][key] == pytest.approx(expected, rel=1e-3)


def test_off_reads_no_tracks(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("splatting.features.sparse_depth.read_tracks", lambda *_: pytest.fail("tracks are read"))
    trained(scene, tmp_path / "off", "--test_iterations", -1)
