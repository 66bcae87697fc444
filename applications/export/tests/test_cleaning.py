"""Cleaning: floaters put in by hand go, no view loses more than allowed, and what is said and drawn."""

import numpy as np
import pytest
import torch
from gaussians import pipeline

import export
from benchmarks.exports import cleaning as benchmark
from benchmarks.exports.cleaning import losses, with_floaters
from gaussian_renderer.blending import weighted_sums
from gaussian_renderer.camera_paths.poses import poses_of
from gaussian_renderer.importance import most_needed
from gaussian_renderer.scored_views import ScoredViews
from scene.scene import Scene
from scene.splats.reading import read_splats
from scene.with_splats import model_of, splats_of
from splatting import cleaning
from splatting.cleaning import Cleaning, clean
from splatting.records.renders import sheet

MOST, FLOATERS = 0.05, 30
VIEWS = ScoredViews(pipeline(), torch.zeros(3), False)


@pytest.fixture(scope="module")
def cleaned(traced_scene) -> tuple[Cleaning, Cleaning]:
    """Cleanings of the model, and of the model with floaters."""
    gaussians, cameras = traced_scene.gaussians, traced_scene.getTrainCameras()
    floating = model_of(with_floaters(splats_of(gaussians), poses_of(cameras), FLOATERS, 0.7))
    return clean(gaussians, cameras, VIEWS, MOST), clean(floating, cameras, VIEWS, MOST)


@pytest.mark.slow
def test_floaters_go_and_no_view_loses_more_than_allowed(cleaned, traced_scene):
    """An independent rendering measures the loss."""
    of_model, floating = cleaned
    assert (~floating.keep[-FLOATERS:]).sum() >= 0.8 * FLOATERS  # the others are in things, or before such a sky
    assert losses(floating).mean() < -1 and losses(floating).max() <= MOST
    assert (~floating.keep[:-FLOATERS]).double().mean() < 0.5
    gaussians = traced_scene.gaussians
    assert 0 < (~of_model.keep).sum() < 0.5 * len(gaussians)
    after = gaussians.part(of_model.keep, gaussians.max_sh_degree)
    for camera in traced_scene.getTrainCameras():
        one, other = (VIEWS.scores([camera], model)["psnr"] for model in (gaussians, after))
        assert one - other <= MOST and other == of_model.after[id(camera)]


@pytest.mark.slow
def test_export_says_and_draws_what_goes(cleaned, traced_scene, tmp_path, monkeypatch, run_export, capsys):
    count, gone, drawn = len(traced_scene.gaussians), int((~cleaned[0].keep).sum()), []
    monkeypatch.setattr(cleaning, "sheet", lambda *content: drawn.append(content) or sheet(*content))
    files = [word for name in ("a.ply", "b.spz", "c.html") for word in ("--to", tmp_path / name)]
    run_export("-m", traced_scene.model_path, *files, "--clean")
    said = capsys.readouterr().out
    assert f"--clean 0.05: {gone:,} of {count:,} Gaussians go" in said and " most, by -0.0" in said
    assert len(read_splats(tmp_path / "a.ply")) == len(read_splats(tmp_path / "b.spz")) == count - gone
    ((titles, rows, _),) = drawn  # once for all files
    assert titles == ("before", "gone", "after") and len(rows) == 3
    names = {camera.image_name for camera in traced_scene.getTrainCameras()}
    assert {name for row in rows for name, _ in row} <= {"", *names}
    before, left_out, after = (np.asarray(image, np.float64) for _, image in rows[0])
    assert before.shape == (60, 80, 3) and left_out.mean() < after.mean() < 1.1 * before.mean()
    assert [path.name for path in tmp_path.glob("*.removed.png")] == ["a.ply.removed.png"]


@pytest.mark.slow
def test_the_table_of_the_benchmark(traced, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["cleaning", "-m", str(traced), "--floaters", "0", "5"])
    benchmark.main()
    first, second = (line.split("|")[2].strip() for line in capsys.readouterr().out.splitlines()[-2:])
    assert first == "0 of 0" and second.endswith(" of 5")


@torch.no_grad()
def _score(scene: Scene, which: torch.Tensor, to_model: bool) -> float:
    """PSNR of test views of some Gaussians, against the whole model's images or the photos."""
    part = scene.gaussians.part(which, scene.gaussians.max_sh_degree)
    if not to_model:
        return VIEWS.scores(scene.getTestCameras(), part)["psnr"]
    changes = [VIEWS.image(c, part) - VIEWS.image(c, scene.gaussians) for c in scene.getTestCameras()]
    return float(torch.stack([-10 * change.square().mean().log10() for change in changes]).mean())


def test_any_first_part_is_a_model(early_scene):
    """A part loses little, and less than the Gaussians of the largest sums of blending weights do."""
    scene = early_scene
    cameras, count = scene.getTrainCameras(), len(scene.gaussians)
    order = most_needed(scene.gaussians, cameras, VIEWS, count)
    assert order.sort().values.tolist() == list(range(count))
    black = torch.zeros(3)
    weights = [weighted_sums(c, scene.gaussians, VIEWS.pipe, black, torch.ones_like)[:, 0].double() for c in cameras]
    by_weight = sum(weights).argsort(descending=True, stable=True)
    for share, least, more in ((2, 33, 1), (4, 25, 1), (8, 21, 0)):
        ours, theirs = (_score(scene, each[: count // share], True) for each in (order, by_weight))
        assert ours > least and ours > theirs + more
    assert _score(scene, order[: count // 2], False) > _score(scene, order, False) - 0.5
    assert torch.equal(order, most_needed(scene.gaussians, cameras, VIEWS, count))


def test_masked_pixels_do_not_count(early_scene):
    """Gaussians that only masked pixels show go first."""
    scene, views = early_scene, ScoredViews(pipeline(), torch.zeros(3), False)
    left = torch.arange(80).expand(1, 60, 80) < 40
    views.mask = lambda camera: left
    camera = scene.getTrainCameras()[0]
    half = most_needed(scene.gaussians, [camera], views, len(scene.gaussians) // 2)
    with torch.no_grad():
        part, whole = scene.gaussians.part(half, scene.gaussians.max_sh_degree), scene.gaussians
        change = (views.image(camera, part) - views.image(camera, whole)).square()
    assert change[..., :40].mean() < 0.1 * change[..., 40:].mean()


def test_an_exported_ply_is_sorted(early_scene, tmp_path, run_export, monkeypatch):
    """A file with all Gaussians begins with those of a smaller one, up to the last ones, which are asked less often.

    A format with an order of its own, and room for all Gaussians, asks for none.
    """
    model, count = early_scene.model_path, len(early_scene.gaussians)
    for name, most in (("all.ply", 10**6), ("few.ply", 1000)):
        run_export("-m", model, "--to", tmp_path / name, "--max_splats", most)
    every, few = read_splats(tmp_path / "all.ply"), read_splats(tmp_path / "few.ply")
    assert len(every) == count and len(few) == 1000
    first = {tuple(mean) for mean in every.means[:1000].tolist()}
    assert len(first & {tuple(mean) for mean in few.means.tolist()}) > 900
    monkeypatch.setattr(export, "most_needed", None)
    run_export("-m", model, "--max_splats", 10**6, "--to", tmp_path / "a.splat")
    assert len(read_splats(tmp_path / "a.splat")) == count
