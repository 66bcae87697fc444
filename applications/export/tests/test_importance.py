"""The order of Gaussians by need: changes are those of a removal, and any first part of the order is a model."""

import pytest
import torch
from gaussians import model, pipeline

import export
import train
from applications.demo.make_scene import make_scene
from applications.export.importance import change_without, most_needed
from gaussian_renderer.blending import weighted_sums
from gaussian_renderer.camera_paths.without_scene import circle_cameras
from gaussian_renderer.scored_views import ScoredViews
from scene.saved_model import load_saved
from scene.scene import Scene
from scene.splats.reading import read_splats

VIEWS = ScoredViews(pipeline(), torch.zeros(3), False)


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    """A short training of the traced scene."""
    folder = tmp_path_factory.mktemp("needed")
    make_scene(folder / "scene", 14, 80, 60, 1500, 0)
    words = "--iterations 400 --densify_from_iter 100 --disable_viewer --test_iterations -1 --quiet --eval --no_curve"
    train.main(["-s", str(folder / "scene"), "-m", str(folder / "model"), *words.split()])
    parser, models, _ = export.options()
    return load_saved(models.extract(export.parse(parser, ["-m", str(folder / "model"), "--to", "a.ply"])), -1)


@torch.no_grad()
def _score(scene: Scene, which: torch.Tensor, to_model: bool) -> float:
    """PSNR of test views of some Gaussians, against the whole model's images or the photos."""
    part = scene.gaussians.part(which, scene.gaussians.max_sh_degree)
    if not to_model:
        return VIEWS.scores(scene.getTestCameras(), part)["psnr"]
    changes = [VIEWS.image(c, part) - VIEWS.image(c, scene.gaussians) for c in scene.getTestCameras()]
    return float(torch.stack([-10 * change.square().mean().log10() for change in changes]).mean())


def test_changes_are_those_of_a_removal():
    """Up to what is below 1/255, or above the cap of an alpha."""
    gaussians = model(40, degree=1)
    camera = circle_cameras(gaussians.get_xyz.detach().numpy())[0]
    image = VIEWS.image(camera, gaussians)
    change = change_without(image, gaussians, torch.ones_like(image))
    for k in change.abs().argsort(descending=True)[:10]:
        without = VIEWS.image(camera, gaussians.part(torch.arange(40) != k, 1))
        removed = (without - image).detach().double().sum()
        assert float(change[k]) == pytest.approx(float(removed), rel=0.02, abs=1)


def test_any_first_part_is_a_model(scene):
    """A part loses little, and less than the Gaussians of the largest sums of blending weights do."""
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


def test_masked_pixels_do_not_count(scene):
    """Gaussians that only masked pixels show go first."""
    views = ScoredViews(pipeline(), torch.zeros(3), False)
    left = torch.arange(80).expand(1, 60, 80) < 40
    views.mask = lambda camera: left
    camera = scene.getTrainCameras()[0]
    half = most_needed(scene.gaussians, [camera], views, len(scene.gaussians) // 2)
    with torch.no_grad():
        part, whole = scene.gaussians.part(half, scene.gaussians.max_sh_degree), scene.gaussians
        change = (views.image(camera, part) - views.image(camera, whole)).square()
    assert change[..., :40].mean() < 0.1 * change[..., 40:].mean()


def test_an_exported_ply_is_sorted(scene, tmp_path, monkeypatch):
    """A file with all Gaussians begins with those of a smaller one, up to the last ones, which are asked less often."""
    for name, count in (("all.ply", 10**6), ("few.ply", 1000)):
        words = ["export.py", "-m", scene.model_path, "--to", str(tmp_path / name), "--max_splats", str(count)]
        monkeypatch.setattr("sys.argv", words)
        export.main()
    every, few = read_splats(tmp_path / "all.ply"), read_splats(tmp_path / "few.ply")
    assert len(every) == len(scene.gaussians) and len(few) == 1000
    first = {tuple(mean) for mean in every.means[:1000].tolist()}
    assert len(first & {tuple(mean) for mean in few.means.tolist()}) > 900


def test_what_nobody_orders_is_not_asked_for(scene, tmp_path, monkeypatch):
    """A format with an order of its own, and room for all Gaussians."""
    words = ["export.py", "-m", scene.model_path, "--max_splats", str(10**6), "--to", str(tmp_path / "a.splat")]
    monkeypatch.setattr("sys.argv", words)
    monkeypatch.setattr(export, "most_needed", None)
    export.main()
    assert len(read_splats(tmp_path / "a.splat")) == len(scene.gaussians)
