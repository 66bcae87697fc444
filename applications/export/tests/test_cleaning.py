"""Cleaning: floaters put in by hand go, no view loses more than allowed, and what is said and drawn."""

import numpy as np
import pytest
import torch
from gaussians import pipeline

import export
import train
from applications.demo.make_scene import make_scene
from applications.export import cleaning
from applications.export.cleaning import Cleaning, clean
from benchmarks.exports import cleaning as benchmark
from benchmarks.exports.cleaning import losses, with_floaters
from gaussian_renderer.camera_paths.poses import poses_of
from gaussian_renderer.scored_views import ScoredViews
from scene.images import store
from scene.images.decode import decode
from scene.saved_model import load_saved
from scene.splats.reading import read_splats
from scene.with_splats import model_of, splats_of
from splatting.records.renders import sheet
from utils.system_utils import UserError

MOST, FLOATERS = 0.05, 30


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A short training of the traced scene, its folder, and its cameras."""
    folder = tmp_path_factory.mktemp("clean")
    make_scene(folder / "scene", 14, 80, 60, 1500, 0)
    words = "--iterations 1000 --densify_from_iter 100 --disable_viewer --test_iterations -1 --quiet --eval --no_curve"
    train.main(["-s", str(folder / "scene"), "-m", str(folder / "model"), *words.split()])
    parser, models, _ = export.options()
    scene = load_saved(models.extract(export.parse(parser, ["-m", str(folder / "model"), "--to", "a.ply"])), -1)
    return folder / "model", scene


@pytest.fixture(scope="module")
def views() -> ScoredViews:
    return ScoredViews(pipeline(), torch.zeros(3), False)


@pytest.fixture(scope="module")
def cleaned(trained, views) -> tuple[Cleaning, Cleaning]:
    """Cleanings of the model, and of the model with floaters."""
    _, scene = trained
    cameras = scene.getTrainCameras()
    floating = model_of(with_floaters(splats_of(scene.gaussians), poses_of(cameras), FLOATERS, 0.7))
    return clean(scene.gaussians, cameras, views, MOST), clean(floating, cameras, views, MOST)


@pytest.mark.slow
def test_floaters_go(cleaned, trained):
    _, floating = cleaned
    gone = ~floating.keep[-FLOATERS:]
    assert gone.sum() >= 0.8 * FLOATERS  # the others are in things, or before a sky of their colour
    assert losses(floating).mean() < -1
    assert (~floating.keep[:-FLOATERS]).double().mean() < 0.5


@pytest.mark.slow
def test_no_view_loses_more_than_allowed(cleaned, trained, views):
    """An independent rendering measures the loss."""
    of_model, floating = cleaned
    _, scene = trained
    assert 0 < (~of_model.keep).sum() < 0.5 * len(scene.gaussians)
    after = scene.gaussians.part(of_model.keep, scene.gaussians.max_sh_degree)
    for camera in scene.getTrainCameras():
        one, other = (views.scores([camera], model)["psnr"] for model in (scene.gaussians, after))
        assert one - other <= MOST and other == of_model.after[id(camera)]
    assert losses(floating).max() <= MOST


@pytest.mark.slow
def test_export_says_and_draws_what_goes(cleaned, trained, tmp_path, monkeypatch, capsys):
    model, scene = trained
    gone = int((~cleaned[0].keep).sum())
    drawn, photos = [], []
    monkeypatch.setattr(cleaning, "sheet", lambda *content: drawn.append(content) or sheet(*content))
    monkeypatch.setattr(store, "decode", lambda path, size: photos.append(path) or decode(path, size))
    words = ["export.py", "-m", str(model), "--to", str(tmp_path / "a.ply"), "--clean"]
    monkeypatch.setattr("sys.argv", [*words, "--to", str(tmp_path / "b.spz"), "--to", str(tmp_path / "c.html")])
    export.main()
    assert len(photos) == len(set(photos)) == len(scene.getTrainCameras())
    said = capsys.readouterr().out
    assert f"--clean 0.05: {gone:,} of {len(scene.gaussians):,} Gaussians go" in said and " most, by -0.0" in said
    assert len(read_splats(tmp_path / "a.ply")) == len(scene.gaussians) - gone
    ((titles, rows, _),) = drawn  # once for all files
    assert titles == ("before", "gone", "after") and len(rows) == 3
    assert {name for row in rows for name, _ in row} <= {"", *(camera.image_name for camera in scene.getTrainCameras())}
    before, left_out, after = (np.asarray(image, np.float64) for _, image in rows[0])
    assert before.shape == (60, 80, 3) and left_out.mean() < after.mean() < 1.1 * before.mean()
    assert len(read_splats(tmp_path / "b.spz")) == len(scene.gaussians) - gone
    pictures = sorted(path.name for path in tmp_path.glob("*.removed.png"))
    assert pictures == ["a.ply.removed.png"] and (tmp_path / "c.html").is_file()
    files = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    monkeypatch.setattr(export, "_PHOTOS", 0.0)  # as where memory is short
    monkeypatch.setattr("sys.argv", [*words, "--to", str(tmp_path / "b.spz"), "--to", str(tmp_path / "c.html")])
    export.main()
    assert len(photos) > 5 * len(set(photos))
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == files
    monkeypatch.setattr("sys.argv", [*words, "0"])
    with pytest.raises(UserError, match="--clean must be above 0 dB, got 0.0"):
        export.main()
    monkeypatch.setattr("sys.argv", ["export.py", "--ply", str(tmp_path / "a.ply"), "--to", "b.ply", "--clean"])
    with pytest.raises(UserError, match="--clean, --walk and meshes need training views"):
        export.main()


@pytest.mark.slow
def test_the_table_of_the_benchmark(trained, monkeypatch, capsys):
    model, _ = trained
    monkeypatch.setattr("sys.argv", ["cleaning", "-m", str(model), "--floaters", "0", "5"])
    benchmark.main()
    first, second = (line.split("|")[2].strip() for line in capsys.readouterr().out.splitlines()[-2:])
    assert first == "0 of 0" and second.endswith(" of 5")
