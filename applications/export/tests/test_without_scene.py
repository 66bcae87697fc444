"""Models without a scene, viewed and exported from a circle around them, or from the poses that a folder records."""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from gaussians import pipeline
from html_scene import balls
from small_splats import written

import export
import view
from applications.export.formats import FORMATS
from applications.export.reading import read_any
from applications.viewer.views import SceneCameras
from gaussian_renderer import render
from gaussian_renderer.camera_paths.without_scene import COUNT, circle_cameras, have_moved, recorded_cameras
from scene.saved_model import read_model
from scene.splats.reading import read_splats
from scene.with_splats import model_of
from utils.camera_utils import camera_to_JSON
from utils.system_utils import UserError


def test_all_views_of_the_circle_show_the_model():
    splats = balls()
    gaussians = model_of(splats)
    for camera in circle_cameras(splats.means):
        image = render(camera, gaussians, pipeline(), torch.zeros(3))["render"].detach()
        shown = (image.sum(0) > 0.1).double()
        rows, columns = shown.nonzero().double().mean(0).tolist()
        assert 0.02 < shown.mean() < 0.75
        assert abs(rows / camera.image_height - 0.5) < 0.15 and abs(columns / camera.image_width - 0.5) < 0.15
    empty = circle_cameras(np.zeros((0, 3), np.float32))
    assert len(empty) == COUNT and np.isfinite(empty[0].T).all()


def _recorded(cameras: list) -> list[dict]:
    """The cameras as a training records them."""
    for camera in cameras:
        camera.width, camera.height = camera.image_width, camera.image_height
    return [camera_to_JSON(number, camera) for number, camera in enumerate(cameras)]


def test_recorded_poses_are_those_of_the_record(tmp_path):
    record, cameras = tmp_path / "cameras.json", circle_cameras(balls().means)
    record.write_text(json.dumps(_recorded(cameras)))
    for one, other in zip(recorded_cameras(record), cameras, strict=True):
        assert one.image_name == other.image_name
        torch.testing.assert_close(one.full_proj_transform, other.full_proj_transform, rtol=0, atol=1e-5)
    record.write_text('[{"img_name": "a"}]')
    with pytest.raises(UserError, match="has no cameras that can be read .'rotation'.; give the scene with -s"):
        recorded_cameras(record)


def test_poses_that_moved_since_the_training_are_told(tmp_path):
    record, cameras = tmp_path / "cameras.json", circle_cameras(balls().means)
    assert not have_moved(tmp_path, cameras)  # as there is none
    for step, moved in ((0.0, False), (1e-6, False), (0.03, True)):
        entries = _recorded(cameras)
        for entry in entries:
            entry["position"][0] += step * COUNT
        record.write_text(json.dumps(entries))
        assert have_moved(tmp_path, cameras[:8]) == moved
    for content in ([entry | {"img_name": "other"} for entry in entries], [{}]):
        record.write_text(json.dumps(content))
        assert not have_moved(tmp_path, cameras)
    record.write_text(json.dumps(entries))
    (tmp_path / "poses.json").touch()
    assert not have_moved(tmp_path, cameras)  # which are corrected


@pytest.fixture
def gone(tmp_path) -> Path:
    """A model folder of the balls, of a scene that is gone, which had the cameras of the circle."""
    splats = balls()
    (tmp_path / "point_cloud/iteration_7").mkdir(parents=True)
    written(tmp_path, ".ply", splats).rename(tmp_path / "point_cloud/iteration_7/point_cloud.ply")
    (tmp_path / "cfg_args").write_text(f"Namespace(sh_degree=1, source_path='{tmp_path}/gone', white_background=False)")
    (tmp_path / "cameras.json").write_text(json.dumps(_recorded(circle_cameras(splats.means))))
    return tmp_path


def test_a_folder_whose_scene_is_gone_keeps_its_poses(gone, capsys):
    options = argparse.Namespace(model_path=str(gone), source_path=str(gone / "gone"), resolution=4)
    scene = view.load_folder(options, argparse.Namespace(iteration=-1, typed_sh_degree=None))
    assert scene.loaded_iter == 7 and len(scene.gaussians) == len(balls())
    assert {(camera.image_width, camera.image_height) for camera in scene.getTrainCameras()} == {(240, 180)}
    assert "gone is gone, so there are poses, but no photos" in capsys.readouterr().err
    with pytest.raises(UserError, match="gone, which is gone; leave it out"):
        view.find_kept(scene, argparse.Namespace(clean=0.05), pipeline(), options)


def test_every_format_of_a_folder_whose_scene_is_gone(gone, monkeypatch, run_export, capsys):
    """In one call, which reads the model once. Those that a program of others writes are not tried."""
    reads, endings = [], [entry.ending for entry in FORMATS if entry.ending not in (".sog", "lod-meta.json")]
    monkeypatch.setattr(export, "read_model", lambda path: reads.append(path) or read_model(path))
    files = [gone / f"{number}{ending}" for number, ending in enumerate(endings)]
    words = ["-r", "8", "--max_splats", "400", "--voxel", "0.1", "--start"]
    run_export("-m", gone, *words, "around 3", *(word for file in files for word in ("--to", file)))
    said = capsys.readouterr()
    assert len(reads) == 1 and said.out.count("600 -> 400 Gaussians: no score, as the photos are gone;") == 1
    assert said.err.count("gone is gone, so there are poses, but no photos") == 1
    assert f"not cleaned, as there is no scene folder {gone}/gone; name it with -s" in said.err
    assert all(file.stat().st_size and f"Wrote {file}: " in said.out for file in files)
    assert len(read_splats(files[endings.index(".ply")])) == 400
    assert "View 10 of 10" in files[-1].read_text(encoding="utf-8")
    for need in ("--clean", "--upright"):
        with pytest.raises(UserError, match="no scene folder .*gone; name|--upright needs a model folder"):
            run_export("-m", gone, "--to", gone / "a.ply", need)


def test_a_file_alone_is_exported_and_shown(tmp_path, run_export):
    path, options = written(tmp_path, ".splat", balls()), pipeline()
    run_export(path, "--to", tmp_path / "out.ply")
    np.testing.assert_array_equal(read_splats(tmp_path / "out.ply").means, read_splats(path).means)
    run_export(path, "--to", tmp_path / "page.html", "--path", "ellipse")
    assert "View 10 of 10" in (tmp_path / "page.html").read_text(encoding="utf-8")
    scene = view.load_file(str(path), options)
    assert scene.loaded_iter == path.name and len(scene.gaussians) == len(balls())
    shown = SceneCameras(scene.getTrainCameras(), scene.getTestCameras())
    assert len(shown.by_name) == COUNT and np.allclose(shown.up, [0, -1, 0], atol=1e-6)
    view.load_file(str(written(tmp_path, ".ply", replace(balls(), antialiasing=True))), options)
    assert options.antialiasing


def test_a_sog_needs_its_program(tmp_path, monkeypatch):
    program, answer = tmp_path / "program", None
    (tmp_path / "a.sog").write_bytes(b"PK")
    monkeypatch.setattr("shutil.which", lambda *_, **__: answer)
    with pytest.raises(UserError, match="a.sog needs splat-transform; install Node"):
        read_any(tmp_path / "a.sog")
    program.write_text("#!/bin/sh\necho Reading; echo ✗ Error: no model >&2; echo failed in 1 s; exit 1\n")
    program.chmod(0o755)
    answer = str(program)
    with pytest.raises(UserError, match=r"a.sog is not read by .*program .Error: no model.; save or download it again"):
        read_any(tmp_path / "a.sog")
