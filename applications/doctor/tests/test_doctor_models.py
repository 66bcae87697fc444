"""Broken models and good ones: doctor.py names what is wrong with each, and calls no good one broken."""

import json
import math
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from trainings import train_on

import applications.doctor.model
from applications.demo.make_scene import make_scene
from applications.doctor.model import check_model
from groundwork.finding import Severity
from scene.gaussians.attributes import Rows
from scene.gaussians.ply import write_ply
from scene.saved_model import read_model

N = 400


@pytest.fixture(scope="module")
def scene(once) -> Path:
    return once("doctor/scene", lambda folder: make_scene(folder, 24, 120, 90, 1500, seed=1))


@pytest.fixture(scope="module")
def trained(scene: Path, once) -> Path:
    """A model whose Gaussians are long, so that their rotations matter."""

    def train(out: Path) -> None:
        words = "--eval", "--iterations", N, "--test_iterations", -1, "--checkpoint_iterations", N
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "stdout", sys.stdout)  # which the command silences
            train_on(scene, out, *words, "--disable_viewer", "--quiet")

    return once("doctor/model", train)


@pytest.fixture
def folder(trained: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(trained, tmp_path / "model"))


def _ply(folder: Path) -> Path:
    return folder / f"point_cloud/iteration_{N}/point_cloud.ply"


def _edit(folder: Path, change: Callable[[Rows], Rows]) -> None:
    gaussians = read_model(_ply(folder))
    rows = change({name: values.clone() for name, values in gaussians.rows().items()})
    write_ply(_ply(folder), rows, gaussians.max_sh_degree)


def _problems(folder: Path, scene: Path | None = None) -> list[str]:
    lines = check_model(str(folder), -1, scene and str(scene))
    return [f"{line.text} -> {line.remedy}" for line in lines if line.is_problem and "only 24 photos" not in line.text]


def _times(positions: float, sizes: float) -> Callable[[Rows], Rows]:
    return lambda rows: rows | {"xyz": positions * rows["xyz"], "scaling": rows["scaling"] + math.log(sizes)}


BROKEN = {
    "times 10": _times(10, 10),
    "times 1.5": _times(1.5, 1.5),
    "positions times 100": _times(100, 1),
    "a mirror": lambda rows: rows | {"xyz": rows["xyz"] * torch.tensor([-1.0, 1, 1])},
    "moved": lambda rows: rows | {"xyz": rows["xyz"] + 3},
    "faded": lambda rows: rows | {"opacity": rows["opacity"].clamp(max=-4.0)},
}


@pytest.mark.parametrize("change", BROKEN.values(), ids=BROKEN.keys())
def test_a_model_that_is_not_that_of_its_training_is_named(folder, change):
    _edit(folder, change)
    (problem,) = _problems(folder)
    assert "dB in training, so the model or the photos are not those of then -> restore" in problem


def test_a_photo_that_somebody_walked_into_is_named(trained, scene, tmp_path):
    other = Path(shutil.copytree(scene, tmp_path / "scene"))
    photo = sorted((other / "images").iterdir())[3]
    pixels = np.array(Image.open(photo))
    pixels[30:60, 20:45] = (255, 0, 255)
    Image.fromarray(pixels).save(photo)
    for folder, named in ((scene, []), (other, [photo.name])):
        lines = check_model(str(trained), -1, str(folder))
        found = [str(line) for line in lines if line.severity == Severity.NOTE and "passers-by" in line.text]
        assert ["most in " + name + ";" in text for text, name in zip(found, named, strict=True)] == [True] * len(named)


@pytest.mark.slow
def test_photos_of_other_cameras_are_found_after_a_training(folder, scene, tmp_path):
    other = Path(shutil.copytree(scene, tmp_path / "scene"))
    _other_photos(other)
    assert _problems(folder, other) == [
        f"the model fits the scene that it was trained on, but not {other} -> give -s {scene}"
    ]
    options = folder / "cfg_args"
    options.write_text(options.read_text().replace(str(scene), str(other)))  # as if they changed after the training
    (problem,) = _problems(folder)
    assert re.search(r"cameras and photos do not fit together: at least 1\d of 21 photos show another view", problem)


def _other_photos(scene: Path) -> None:
    photos = sorted((scene / "images").iterdir())
    contents = [path.read_bytes() for path in photos]
    for path, content in zip(photos, contents[8:] + contents[:8], strict=True):
        path.write_bytes(content)


@pytest.mark.parametrize("log", [True, False], ids=["log", "no log"])
def test_colours_that_nothing_explains(folder, log):
    """With a log, the recorded scores show that something has changed."""
    for name in () if log else ("train_log.json", "error_vs_time.csv"):
        (folder / name).unlink()
    _edit(folder, lambda rows: rows | {"f_dc": -rows["f_dc"], "f_rest": -rows["f_rest"]})
    (problem,) = _problems(folder)
    assert ("are not those of then" if log else "dB -> train longer, 3000 iterations at least") in problem


def test_opacities_that_were_reset_too_late(folder, monkeypatch):
    log = folder / "train_log.json"
    records = json.loads(log.read_text())
    said = "warning: opacities are reset in iteration 300, and the remaining 100 are too few to recover; change it"
    records[-1]["lines"] = [said, *records[-1].get("lines", [])]
    log.write_text(json.dumps(records))
    assert _problems(folder) == []  # they did recover
    monkeypatch.setattr(applications.doctor.model, "UNRECOVERED", 1.0)
    assert _problems(folder) == [said.removeprefix("warning: ").replace("; ", " -> ")]


GOOD = {
    "as it is": lambda rows: rows,
    "other signs of quaternions": lambda rows: rows | {"rotation": -rows["rotation"]},
    "longer quaternions": lambda rows: rows | {"rotation": 7 * rows["rotation"]},
    "another order": lambda rows: {name: values.flip(0) for name, values in rows.items()},
}


@pytest.mark.parametrize("change", GOOD.values(), ids=GOOD.keys())
def test_good_models(folder, change):
    _edit(folder, change)
    assert _problems(folder) == []


def test_a_model_of_small_photos_is_looked_at_in_their_size(scene, tmp_path):
    """Such a model lacks the detail of larger views, in which it would score far below the recorded numbers."""
    words = "--eval", "-r", 4, "--iterations", 800, "--test_iterations", 800, "--disable_viewer", "--quiet"
    train_on(scene, tmp_path / "small", *words)
    assert _problems(tmp_path / "small") == []
    said = [line.text for line in check_model(str(tmp_path / "small"), -1)]
    assert any("rendered 30 pixels wide" in text for text in said)
    assert not any("passers-by" in text for text in said)
