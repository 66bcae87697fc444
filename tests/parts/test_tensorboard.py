"""TensorBoard's events: written where it is installed, and no reason for a training to end."""

import math
import sys
import types
from io import BytesIO
from pathlib import Path

import pytest
import torch
from PIL import Image

import train
from applications.doctor import environment
from applications.evaluation.peer_curve import read_scalars
from splatting import events
from splatting.events import EventWriter


def _train(scene: Path, out: Path, *more: str) -> None:
    train.main(["-s", str(scene), "-m", str(out), "-r", "24", "--eval", "--no_curve", *more])


class _Writer:
    """A stand-in for torch's SummaryWriter, whose disk is full after some scalars."""

    room = math.inf

    def __init__(self, folder: str, flush_secs: int) -> None:
        self.scalars: dict[str, dict[int, float]] = {}
        self.shown: list[tuple[str, int]] = []  # images and histograms
        _Writer.last = self

    def add_scalar(self, tag: str, value: float, step: int) -> None:
        if sum(map(len, self.scalars.values())) >= self.room:
            raise OSError(28, "No space left on device")
        self.scalars.setdefault(tag, {})[step] = value

    def add_histogram(self, tag: str, values: torch.Tensor, step: int) -> None:
        self.shown.append((tag, step))

    def add_image(self, tag: str, image: torch.Tensor, global_step: int) -> None:
        assert image.shape[0] == 3 and image.is_floating_point()
        self.shown.append((tag, global_step))

    def close(self) -> None:
        self.scalars["closed"] = {}


@pytest.fixture(autouse=True)
def writer(monkeypatch: pytest.MonkeyPatch) -> type[_Writer]:
    module = types.ModuleType("torch.utils.tensorboard")
    module.SummaryWriter = _Writer
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", module)
    monkeypatch.setattr(EventWriter, "_add_jpeg", lambda self, *given: self._writer.add_image(*given))
    monkeypatch.setattr(sys, "stdout", sys.stdout)
    return _Writer


def test_tags_are_the_references(colmap_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(events, "INTERVAL", 2)
    _train(colmap_scene, tmp_path, "--iterations", "3", "--test_iterations", "2", "3")
    scalars, shown = _Writer.last.scalars, _Writer.last.shown
    every = {tag: list(values) for tag, values in scalars.items()}
    losses = dict.fromkeys(("train_loss_patches/l1_loss", "train_loss_patches/total_loss", "iter_time"), [2])
    scores = [f"{name}/loss_viewpoint - {score}" for name in ("test", "train") for score in ("l1_loss", "psnr")]
    assert every == losses | dict.fromkeys((*scores, "total_points"), [2, 3]) | {"closed": []}
    assert [step for tag, step in shown if tag == "scene/opacity_histogram"] == [2, 3]
    assert sum(tag.startswith("test_view_") and tag.endswith("/render") for tag, step in shown if step == 3) == 3
    assert {step for tag, step in shown if tag.endswith("/ground_truth")} == {2}


def test_without_tensorboard_doctor_says_so_and_not_each_training(colmap_scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    _train(colmap_scene, tmp_path, "--iterations", "1")
    assert "TensorBoard" not in "".join(capsys.readouterr()) and not [*tmp_path.rglob("events.out*")]
    version = environment._read_version
    monkeypatch.setattr(environment, "_read_version", lambda name: None if name == "tensorboard" else version(name))
    assert any(
        "no TensorBoard, so trainings write no event files" in line.text for line in environment.check_packages()
    )


@pytest.mark.parametrize("room", [0, 5])
def test_events_that_cannot_be_written_are_one_warning(colmap_scene, tmp_path, monkeypatch, capsys, room):
    monkeypatch.setattr(_Writer, "room", room)
    _train(colmap_scene, tmp_path, "--iterations", "30", "--test_iterations", "10", "30")
    said = capsys.readouterr().err
    assert said.count("No space left") == said.count("training continues without them") == 1
    assert sum(map(len, _Writer.last.scalars.values())) == room


def test_tensorboard_reads_them(colmap_scene, tmp_path, monkeypatch):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    monkeypatch.undo()
    monkeypatch.setattr(sys, "stdout", sys.stdout)
    _train(colmap_scene, tmp_path, "--iterations", "10", "--test_iterations", "10")
    events = accumulator.EventAccumulator(str(tmp_path), {"scalars": 0, "images": 0, "histograms": 0}).Reload()
    assert len(events.Tags()["images"]) == 2 * (3 + 5)  # renders and photos of three test views and five training views
    assert Image.open(BytesIO(events.Images(events.Tags()["images"][0])[0].encoded_image_string)).size == (24, 16)
    assert events.Tags()["histograms"] == ["scene/opacity_histogram"]
    (file,) = tmp_path.glob("events.out.tfevents.*")
    scalars = read_scalars(tmp_path)
    assert {"iter_time", "total_points", "test/loss_viewpoint - psnr"} <= scalars.keys()
    assert [scalar.step for scalar in scalars["iter_time"]] == [10]
    for damaged in (file.read_bytes()[:-3], b"\xff" * 100):  # what is whole is read
        file.write_bytes(damaged)
        assert len(read_scalars(tmp_path)) < len(scalars)
