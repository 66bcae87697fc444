"""A sky (--sky): where it is found, that it stays there, and trainings with it."""

import math
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic import options_of
from trainings import trained

import export
import train
from applications.demo.make_scene import Things, write_scene
from applications.demo.objects import Box, Thing, demo_scene
from applications.demo.tracer import ring_views, shade, trace
from benchmarks.scenes.made import add_sky
from groundwork.files.json_files import read_model_json
from scene.gaussian_model import GaussianModel
from scene.readers.tracks import projected
from scene.scene import Scene
from scene.splats.reading import read_splats
from splatting.features.sky_shell import FEWEST, Shell, find_sky
from splatting.features.time_budget_file import write_schedule
from splatting.features.time_budget_schedule import Block, Decided
from utils.system_utils import UserError

ON = "--sky", "auto", "--densify_grad_threshold", 1e-5


def _made(folder: Path, things: Things) -> Path:
    rng = np.random.default_rng(0)
    write_scene(folder, ring_views(24, 120, 90, rng), things, 6000, rng, samples=1)
    return folder


@pytest.fixture(scope="module")
def scene(once) -> Path:
    return once("sky_scene", lambda folder: _made(folder, add_sky))


def _found(folder: Path) -> tuple[Scene, Shell, np.ndarray, np.ndarray, float]:
    scene = Scene(options_of(folder, folder / "out"), GaussianModel(0), start=False)
    sky = Shell.around(scene.info)
    cloud, share = find_sky(scene, sky)
    return scene, sky, cloud.points, cloud.colors, share


def test_it_is_where_rays_meet_nothing_and_has_the_colours_there(scene):
    """The tracer of the scene gives the expected directions and colours."""
    loaded, sky, points, colors, share = _found(scene)
    np.testing.assert_allclose(np.linalg.norm(points - sky.center, axis=1), sky.radius, rtol=1e-9)
    sky.points, things, shown, hit = points, add_sky(None), 0, 0
    for camera in loaded.getTrainCameras():
        view = loaded.info.train_cameras[camera.uid]
        toward = (points[projected(view, points)[2]] - view.center).T
        toward, center = (toward / np.linalg.norm(toward, axis=0)).astype(np.float32), np.float32(view.center)[:, None]
        shown += toward.shape[1]
        hit += np.isfinite(trace(things, center, toward)[0]).sum()
        assert (sky.at(camera, loaded) is not None) == (toward.shape[1] > 0)
    assert shown > 1000 and hit < 0.01 * shown and share > FEWEST
    toward = ((points - sky.center) / sky.radius).T.astype(np.float32)
    seen = shade(add_sky(0), np.float32(sky.center)[:, None], toward)
    assert np.abs(colors - seen.T).mean() < 0.02


def test_there_is_none_before_a_backdrop_with_points(tmp_path):
    assert _found(_made(tmp_path / "clean", lambda _: demo_scene()))[-1] < FEWEST


def _indoors(photo: int | None) -> list[Thing]:
    """The demo's things in a room whose smooth walls differ a little, and have no points."""
    box, _, *things = Thing(Box((0, -1.5, 0), (5.5, 3.0, 5.5), 0.0), _walls, emissive=True), *demo_scene()
    return things if photo is None else [box, *things]


def _walls(points: np.ndarray) -> np.ndarray:
    """One colour for each wall."""
    wall = np.abs((points - [[0], [-1.5], [0]]) / [[5.5], [3.0], [5.5]]).argmax(0)
    return np.float32([[0.85, 0.90, 0.80], [0.83, 0.90, 0.84], [0.78, 0.90, 0.86]])[:, wall]


def test_there_is_none_in_a_room_of_smooth_walls_without_points(tmp_path):
    """Its edges move from photo to photo as those of near walls."""
    assert _found(_made(tmp_path / "room", _indoors))[-1] == 0


def _thinned(scene: Path, out: Path, every: int) -> Path:
    """The scene with every so many of its points."""
    import pycolmap  # after Pillow

    shutil.copytree(scene, out)
    model = pycolmap.Reconstruction(str(out / "sparse/0"))
    for rank, point in enumerate(sorted(model.points3D)):
        if rank % every:
            model.delete_point3D(point)
    model.write_binary(str(out / "sparse/0"))
    return out


def test_there_is_none_where_few_points_tell_of_one(scene, tmp_path):
    assert _found(_thinned(scene, tmp_path / "few", 4))[-1] == 0
    assert _found(_thinned(scene, tmp_path / "fewer", 2))[-1] >= FEWEST


def _model(means: torch.Tensor, log_scale: float) -> GaussianModel:
    count, gaussians = len(means), GaussianModel(0)
    rows = {name: torch.zeros(count, *values.shape[1:]) for name, values in gaussians.rows().items()}
    gaussians.set_rows(rows | {"xyz": means, "scaling": torch.full((count, 3), log_scale)})
    return gaussians


def test_what_is_far_comes_back_to_the_sphere_and_what_is_near_stays():
    sky = Shell([1.0, 2.0, 3.0], 100.0)
    means = torch.tensor([[1.0, 2.0, 73.0], [1.0, 2.0, -147.0], [41.0, 2.0, 3.0], [0.0, 0.0, 0.0]])
    gaussians = _model(means, math.log(20.0))
    sky.hold(gaussians)
    expected = torch.tensor([[1.0, 2.0, 103.0], [1.0, 2.0, -97.0]])
    torch.testing.assert_close(gaussians.get_xyz[:2].detach(), expected)
    assert torch.equal(gaussians.get_xyz[2:], means[2:])
    torch.testing.assert_close(gaussians.get_scaling[:, 0].detach(), torch.tensor([6.25, 6.25, 20.0, 20.0]))


@pytest.mark.slow
def test_a_training_keeps_it_and_exports_leave_it_out(scene, tmp_path, monkeypatch):
    """Rows change, and after a reset of opacities density control removes what is large."""
    trained(scene, tmp_path / "whole", *ON)
    known = read_model_json(tmp_path / "whole")["sky"]
    model = read_splats(tmp_path / "whole/point_cloud/iteration_60/point_cloud.ply")
    distances = np.linalg.norm(model.means - known["center"], axis=1) / known["radius"]
    far = distances > 0.5
    assert far.sum() > len(_found(scene)[2]) and np.exp(model.log_scales[far]).max() > 0.1 * known["radius"] / 100
    assert np.abs(distances[far] - 1).max() < 1e-3 and distances[~far].max() < 0.1
    words = f"export.py -m {tmp_path}/whole --no_sky --to {tmp_path}/near.ply --quiet"
    monkeypatch.setattr(sys, "argv", words.split())
    export.main()
    np.testing.assert_array_equal(read_splats(tmp_path / "near.ply").means, model.means[~far])


def test_none_begins_in_a_resumed_training(scene, tmp_path, capsys):
    words = ["-s", str(scene), "-m", str(tmp_path), "--no_curve", "--iterations"]
    train.main([*words, "2", "--checkpoint_iterations", "2"])
    train.main([*words, "3", "--sky", "auto", "--start_checkpoint", str(tmp_path / "chkpnt2.pth")])
    assert "the checkpoint has no sky, and only new trainings add one" in capsys.readouterr().out
    assert read_model_json(tmp_path).get("sky") is None


def test_what_cannot_be_is_refused_in_one_sentence(scene, tmp_path):
    with pytest.raises(UserError, match="--no_sky needs a model folder"):
        export.find_sky(str(tmp_path), np.zeros((1, 3)))
    file = tmp_path / "schedule.json"
    write_schedule(file, Decided(100, [Block(9, 0.0, 1 / 9, 0.0)], 9, 9.0, strategy="mcmc"))
    words = ["-s", str(scene), "-m", str(tmp_path), "--iterations", "100", "--schedule", str(file)]
    with pytest.raises(UserError, match="--sky does not work with --strategy mcmc"):  # which is known late
        train.main([*words, "--sky", "auto"])
    for broken in (None, {"center": [0, 1], "radius": 2}, {"center": [0, 1, 2], "radius": math.nan}):
        with pytest.raises(UserError, match="the saved sky lacks a valid centre and radius"):
            Shell.restored(broken)
