"""The census of stiffness: its numbers on hand-made Gaussians, and the command on small models."""

import math
import sys

import pytest
import torch
from diff_gaussian_rasterization import Gaussians
from gaussians import model

from benchmarks.accuracy import census
from benchmarks.accuracy.splat_shapes import count_cells, measure_splats
from tests.workloads.splat_scenes import settings

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
    (splats,) = measure_splats(GAUSSIANS, camera)
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
    assert count_cells(splats) == {(2, 0, 2, 2, 0): 1, (1, 0, 0, 3, 0): 1}
    covariances = torch.tensor([[0.25, 0, 0, 1.6e-5, 0, 0.01]])
    given = GAUSSIANS._replace(means=GAUSSIANS.means[:1], opacities=splats.opacity[:1, None])
    (same,) = measure_splats(given._replace(scales=None, rotations=None, cov3d=covariances), camera, raw=False)
    assert [float(value[0]) for value in same] == pytest.approx([float(value[0]) for value in splats], rel=1e-4)


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
