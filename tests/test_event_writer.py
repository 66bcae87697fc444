"""TensorBoard's event files, written without TensorBoard."""

import io
import json
import math
import struct
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import train
from evaluation.tensorboard_scalars import _fields, _records, read_scalars
from records import event_file, event_writer
from records.event_writer import EventWriter
from training.objective import Losses
from training.observers import progress
from training.observers.report import Report
from training.step import Step
from utils.files import crc32c as checksums
from utils.files.crc32c import crc32c


def _values(folder: Path) -> dict[str, dict[int, bytes | int]]:
    """Fields of the values of the only event file, by tag."""
    (path,) = folder.glob("events.out.tfevents.*")
    first, *others = _records(path.read_bytes())
    assert dict(_fields(first))[3] == b"brain.Event:2"
    values = [dict(_fields(dict(_fields(dict(_fields(event))[5]))[1])) for event in others]
    return {value[1].decode(): value for value in values}


@pytest.mark.parametrize(
    ("data", "wanted"),
    [(b"123456789", 0xE3069283), (bytes(32), 0x8A9136AA), (b"\xff" * 32, 0x62A8AB43), (bytes(range(32)), 0x46DD794E)],
)
def test_checksums_of_the_standard(data, wanted):
    """Of RFC 3720, B.4, and the usual check."""
    assert crc32c(data) == checksums._in_lanes(data) == wanted


@pytest.mark.parametrize("size", [4, 1023, 1024, 4095, 4096, 4097, 100_003])
def test_long_data_read_in_lanes_has_the_same_checksum(monkeypatch, size):
    data = np.random.default_rng(size).integers(0, 256, size, dtype=np.uint8).tobytes()
    in_lanes = checksums._in_lanes(data)
    monkeypatch.setattr(checksums, "_LONG", size + 1)
    assert crc32c(data) == in_lanes


def test_every_record_has_its_checksums(tmp_path):
    writer = EventWriter(str(tmp_path))
    writer.add_scalar("a", 1.0, 3)
    writer.close()
    (path,) = tmp_path.iterdir()
    data, count = path.read_bytes(), 0
    while data:
        (length,) = struct.unpack_from("<Q", data)
        for part, at in ((data[:8], 8), (data[12 : 12 + length], 12 + length)):
            crc = crc32c(part)
            masked = (((crc >> 15) | (crc << 17)) + 0xA282EAD8) & 0xFFFFFFFF
            assert struct.unpack_from("<I", data, at) == (masked,)
        data, count = data[16 + length :], count + 1
    assert count == 2


def test_scalars_are_read_back(tmp_path):
    writer = EventWriter(str(tmp_path))
    for step in (10, 20, 300):
        writer.add_scalar("loss", step / 8, step)
    writer.add_scalar("huge", 1e300, 1)
    writer.flush()
    found = read_scalars(tmp_path)
    assert [(scalar.step, scalar.value) for scalar in found["loss"]] == [(10, 1.25), (20, 2.5), (300, 37.5)]
    assert found["huge"][0].value == float("inf") and found["loss"][0].wall <= found["loss"][2].wall
    writer.close()


def test_a_burst_is_written_at_once(tmp_path, monkeypatch):
    """The file is opened for all of it, not for every number, and who flushes or closes does not wait for more."""
    writer, opened, plain = EventWriter(str(tmp_path)), [], Path.open
    writer.flush()
    monkeypatch.setattr(event_writer, "_PAUSE", 3600.0)
    monkeypatch.setattr(Path, "open", lambda path, mode="r": opened.append(mode) or plain(path, mode))
    for step in range(100):
        writer.add_scalar("loss", step, step)
    assert not opened
    writer.flush()
    assert opened == ["ab"] and [scalar.step for scalar in read_scalars(tmp_path)["loss"]] == list(range(100))
    writer.add_scalar("loss", 7.0, 100)
    writer.close()
    assert len(read_scalars(tmp_path)["loss"]) == 101


def test_an_image_is_a_png_of_eight_bits(tmp_path):
    image = torch.rand(3, 5, 7, generator=torch.Generator().manual_seed(0)) * 1.2 - 0.1
    writer = EventWriter(str(tmp_path))
    writer.add_image("view", image, global_step=4)
    writer.close()
    content = dict(_fields(_values(tmp_path)["view"][4]))
    assert (content[1], content[2], content[3]) == (5, 7, 3)
    with Image.open(io.BytesIO(content[4])) as png:
        pixels = np.asarray(png)
    assert np.array_equal(pixels, (image * 255).clamp(0, 255).byte().permute(1, 2, 0).numpy())


def test_a_histogram_counts_what_is_finite(tmp_path):
    values = torch.tensor([[0.0], [0.5], [0.5], [-2.0], [float("nan")], [float("inf")], [1e-3]])
    writer = EventWriter(str(tmp_path))
    writer.add_histogram("opacity", values, 4)
    values.fill_(7.0)  # what happens later does not count
    writer.add_histogram("nothing", torch.tensor([float("nan")]), 4)
    writer.close()
    found = _values(tmp_path)
    assert list(found) == ["opacity"]
    content = dict(_fields(found["opacity"][5]))
    low, high, count, total, squares = (struct.unpack("<d", content[number])[0] for number in range(1, 6))
    assert (low, high, count) == (-2.0, 0.5, 5)
    assert total == pytest.approx(-0.999) and squares == pytest.approx(4.500001)
    limits, counts = (np.frombuffer(content[number], "<f8") for number in (6, 7))
    assert len(limits) == len(counts) and counts[0] == 0 and counts.sum() == 5 and (np.diff(limits) > 0).all()
    assert limits[0] <= -2.0 < limits[1] and limits[-2] <= 0.5 < limits[-1] and counts[-1] == 2


def test_what_cannot_be_written_is_one_warning(tmp_path, capfd):
    folder = tmp_path / "gone"
    folder.mkdir()
    writer = EventWriter(str(folder))
    writer.flush()
    next(folder.iterdir()).unlink()
    folder.rmdir()
    for step in range(3):
        writer.add_scalar("loss", 1.0, step)
    writer.close()
    said = capfd.readouterr().err
    assert said.count("warning: cannot write") == 1 and "training continues" in said


def test_everything_else_is_done_by_tensorboards_own(tmp_path, monkeypatch):
    calls = []

    class Writer:
        def __init__(self, folder: str) -> None:
            calls.append(folder)

        def add_text(self, *words: object) -> None:
            calls.append(words)

        add_image = add_scalar = add_histogram = add_text

        def flush(self) -> None:
            calls.append("flushed")

        def close(self) -> None:
            calls.append("closed")

    module = types.ModuleType("torch.utils.tensorboard")
    module.SummaryWriter = Writer
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", module)
    writer = EventWriter(str(tmp_path))
    writer.add_scalar("loss", 1.0, 1)
    assert calls == [] and not hasattr(writer, "_private")
    writer.add_text("a", "b", 1)
    writer.add_text("a", "c", 2)
    grey, numbers = torch.zeros(1, 4, 4), np.zeros(3)
    writer.add_image("grey", grey, 3)
    writer.add_histogram("numbers", numbers, 4)
    writer.add_scalar("then", 1.0, 5, 1e9)
    writer.flush()
    writer.close()
    assert calls[:3] == [str(tmp_path), ("a", "b", 1), ("a", "c", 2)]
    assert [words[::2] for words in calls[3:5]] == [("grey", 3), ("numbers", 4)]
    assert calls[5:] == [("then", 1.0, 5, 1e9), "flushed", "closed"]


def test_a_training_tells_tensorboard_where_it_is_installed(colmap_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "stdout", sys.stdout)
    monkeypatch.setattr(train, "SummaryWriter", EventWriter)
    words = ["-s", colmap_scene, "-m", tmp_path / "out", "-r", "24", "--iterations", "10", "--eval", "--no_curve"]
    train.main([*map(str, words), "--test_iterations", "10"])
    scalars = read_scalars(tmp_path / "out")
    assert [scalars[tag][0].step for tag in ("iter_time", "total_points", "test/loss_viewpoint - psnr")] == [10] * 3
    scores = json.loads((tmp_path / "out" / "train_log.json").read_text())[-1]
    assert scalars["test/loss_viewpoint - psnr"][0].value == pytest.approx(scores["test_psnr"], rel=1e-6)
    images = [value for value in _values(tmp_path / "out").values() if 4 in value]
    assert len(images) == 2 * (3 + 5)  # renders and photos of three test views and five training views


def test_every_tenth_iteration_has_its_own_losses(colmap_scene, tmp_path, monkeypatch):
    """They are kept until something is due, and read together."""
    measured, plain = {}, Report.measured

    def measure(self: Report, step: Step, losses: Losses) -> None:
        measured[step.iteration] = losses.l1.item(), losses.total.item()
        plain(self, step, losses)

    monkeypatch.setattr(sys, "stdout", sys.stdout)
    monkeypatch.setattr(train, "SummaryWriter", EventWriter)
    monkeypatch.setattr(Report, "measured", measure)
    monkeypatch.setattr(progress, "BAR_SECONDS", math.inf)  # nothing but the tests is due
    words = ["-s", colmap_scene, "-m", tmp_path, "-r", "24", "--iterations", "40", "--eval", "--no_curve"]
    train.main([*map(str, words), "--test_iterations", "30"])
    scalars = read_scalars(tmp_path)
    for place, name in enumerate(("l1_loss", "total_loss")):
        told = {scalar.step: scalar.value for scalar in scalars[f"train_loss_patches/{name}"]}
        assert told == {t: measured[t][place] for t in (10, 20, 30, 40)}
    assert len({loss for pair in measured.values() for loss in pair}) == 80  # a mistaken place would show


def test_tensorboard_reads_them(tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    writer = EventWriter(str(tmp_path))
    writer.add_scalar("loss", 0.25, 10)
    writer.add_image("view", torch.full((3, 200, 300), 0.5), 10)
    writer.add_histogram("opacity", torch.rand(20_000, 1), 10)
    writer.close()
    events = accumulator.EventAccumulator(str(tmp_path)).Reload()
    assert [(e.step, e.value) for e in events.Scalars("loss")] == [(10, 0.25)]
    assert (events.Images("view")[0].width, events.Images("view")[0].height) == (300, 200)
    assert sum(events.Histograms("opacity")[0].histogram_value.bucket) == 20_000


def test_a_number_of_many_bits_is_cut_into_sevens():
    assert [event_file._varint(value) for value in (0, 127, 128, 300)] == [b"\0", b"\x7f", b"\x80\1", b"\xac\2"]
