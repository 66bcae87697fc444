"""The census of stiffness: its numbers on hand-made Gaussians, and the command on small models."""

import math
import sys

import pytest
import torch
from diff_gaussian_rasterization import Gaussians
from gaussians import model

from benchmarks.accuracy import census, splat_shapes
from benchmarks.accuracy.splat_shapes import Histogram, Sorted, cells, seen
from benchmarks.accuracy.trained_models import TrainedModel, around, trained
from benchmarks.workloads.splat_scenes import settings
from utils.system_utils import UserError

# On the axis at depths 5 and 2, behind the camera, and not finite; flat ones as seen by the camera.
SCALES = torch.tensor([[0.5, 0.004, 0.1], [0.2, 0.2, 0.016], [1, 1, 1], [1, 1, 1]])
GAUSSIANS = Gaussians(
    torch.tensor([[0, 0, 5], [0, 0, 2], [0, 0, -5], [0, math.nan, 5]]),
    torch.tensor([[-2.0], [5], [0], [0]]),
    SCALES.log(),
    torch.tensor([[2.0, 0, 0, 0]]).expand(4, 4).contiguous(),
    sh_dc=torch.zeros(4, 1, 3),
    sh_rest=torch.zeros(4, 15, 3),
)


def test_numbers_of_splats_on_the_axis():
    camera = settings(100, 100)
    (splats,) = seen(GAUSSIANS, camera)
    focal = 50 / math.tan(math.radians(30))
    assert splats.row.tolist() == [0, 1]
    across = [[focal * 0.5 / 5, focal * 0.004 / 5], [focal * 0.2 / 2] * 2]
    variances = [[side**2 + 0.3 for side in pair] for pair in across]
    expected = {
        "ratio": [125, 12.5],
        "length": [max(pair) ** 0.5 for pair in variances],
        "condition": [max(pair) / min(pair) for pair in variances],
        "opacity": [1 / (1 + math.exp(2)), 1 / (1 + math.exp(-5))],
        "depth": [5, 2],
    }
    for name, values in expected.items():
        assert getattr(splats, name).tolist() == pytest.approx(values, rel=1e-6), name
    assert cells(splats) == {(2, 0, 2, 2, 0): 1, (1, 0, 0, 3, 0): 1}
    covariances = torch.tensor([[0.25, 0, 0, 1.6e-5, 0, 0.01]])
    given = GAUSSIANS._replace(means=GAUSSIANS.means[:1], opacities=splats.opacity[:1, None])
    (same,) = seen(given._replace(scales=None, rotations=None, cov3d=covariances), camera, raw=False)
    assert [float(value[0]) for value in same] == pytest.approx([float(value[0]) for value in splats], rel=1e-4)


def test_chunks_and_all_at_once_agree(monkeypatch):
    monkeypatch.setattr(splat_shapes, "ROWS", 1)
    one_by_one = list(seen(GAUSSIANS, settings(100, 100)))
    assert [part.row.tolist() for part in one_by_one] == [[0], [1], [], []]


def test_distributions_tell_quantiles_and_what_lies_beyond():
    numbers = torch.logspace(-3, 5, 1001, dtype=torch.float64)
    counted = Histogram("cpu")
    for part in numbers.split(100):
        counted.add(part)
    for found, error in ((Sorted(numbers.flip(0)), 1e-9), (counted, 0.024)):
        for share in (0.0, 0.1, 0.5, 0.999, 1.0):
            assert found.quantile(share) == pytest.approx(10 ** (-3 + 8 * share), rel=error)
        assert found.beyond(10.0) == pytest.approx(0.5, abs=2e-3)
        assert found.beyond(1e-2, below=True) == pytest.approx(1 / 8, abs=2e-3)
        assert (found.beyond(math.inf), found.beyond(1e-9), found.beyond(1e-9, below=True)) == (0, 1, 0)
        places, above = found.curve()
        assert all(found.beyond(x) == pytest.approx(y, abs=2e-3) for x, y in zip(places[::9], above[::9], strict=True))


def test_the_command_prints_quantiles_cases_and_what_no_case_covers(tmp_path, monkeypatch, capsys):
    gaussians = model(50)
    with torch.no_grad():
        gaussians.raw("scaling")[:, 0] += 8  # needles of ratios that the first cases do not have
    gaussians.save_ply(tmp_path / "a.ply")
    monkeypatch.setattr(census, "CASES", census.CASES[:2])
    words = ["census", f"thin={tmp_path / 'a.ply'}", str(tmp_path / "a.ply"), "--figure", str(tmp_path / "a.png")]
    monkeypatch.setattr(sys, "argv", words)
    census.main()
    said = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in said.splitlines() if line.startswith("| ")]
    assert [row[1] for row in rows if row[0] == "thin"][:5] == list(census.AXES.values())
    assert "thin: 50 Gaussians, 8 made views" in said and [row for row in rows if row[0] == "a"]
    (case,) = (row for row in rows if row[0] == "needles, axes 1 : 1e+02")
    assert case[1].startswith("100 (")
    assert [row for row in rows if row[0] == "thin" and row[-1].endswith("%")]
    assert (tmp_path / "a.png").stat().st_size > 10_000


def test_made_cameras_look_at_the_middle_from_around_it():
    gaussians = model(500)
    rows = Gaussians(gaussians.raw("xyz").detach(), None, sh_rest=gaussians.raw("f_rest"))
    cameras = around(rows)
    middle = rows.means.double().median(0).values
    seen_at = torch.stack([torch.cat([middle, torch.ones(1)]).double() @ camera.viewmatrix for camera in cameras])
    distance = 2 * (rows.means.double() - middle).norm(dim=1).median()
    expected = torch.stack([0 * distance, 0 * distance, distance, torch.ones(())]).expand(8, 4)
    torch.testing.assert_close(seen_at, expected, rtol=1e-6, atol=1e-6)
    places = torch.stack([camera.campos for camera in cameras])
    torch.testing.assert_close(places.mean(0), middle, rtol=1e-6, atol=1e-6)


def test_a_ply_of_a_training_must_lie_in_its_iterations_folder(tmp_path):
    (tmp_path / "cfg_args").write_text("Namespace()")
    gaussians = model(5)
    gaussians.save_ply(tmp_path / "point_cloud/best/point_cloud.ply")
    with pytest.raises(UserError, match="is in no folder iteration_N"):
        trained(str(tmp_path / "point_cloud/best/point_cloud.ply"), "cpu")


def test_a_model_that_no_view_shows_is_refused():
    behind = GAUSSIANS._replace(means=torch.full((4, 3), -5.0))
    with pytest.raises(UserError, match="no view shows a Gaussian of empty"):
        census.census(TrainedModel("empty", behind, [settings(100, 100)], []))
