"""Joules beside seconds, by a stand-in for NVML: there is no GPU here."""

import json
import math
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import train
from groundwork.host.energy import joules_counter
from splatting.records.model_folder import training_joules
from splatting.records.training_log import Stopwatch, TrainingLog


class NvmlError(Exception):
    """The error that NVML raises."""


@pytest.fixture
def used(monkeypatch) -> dict[str, float]:
    """Millijoules of each GPU that a stand-in for pynvml has; without an entry the driver does not tell."""
    counts: dict[str, float] = {}
    known = ("GPU-a", "GPU-b")

    def handle(name: str) -> str:
        if name not in known:
            raise NvmlError("not found")
        return name

    def total(name: str) -> float:
        if name not in counts:
            raise NvmlError("not supported")
        return counts[name]

    nvml = SimpleNamespace(
        NVMLError=NvmlError, nvmlInit=lambda: None, nvmlDeviceGetHandleByUUID=handle,
        nvmlDeviceGetTotalEnergyConsumption=total,
    )  # fmt: skip
    monkeypatch.setitem(sys.modules, "pynvml", nvml)
    return counts


def test_joules_are_those_of_all_gpus_each_once(used):
    used |= {"GPU-a": 5000, "GPU-b": 3000}
    assert joules_counter(["GPU-a"])() == 5
    both = joules_counter(["GPU-a", "GPU-b", "GPU-a"])  # two ranks share one
    assert both() == 8
    used["GPU-b"] = 4500
    assert both() == 9.5
    del used["GPU-b"]  # lost
    assert math.isnan(both())


def test_without_nvml_or_its_answer_there_are_none(used, monkeypatch, capfd):
    used["GPU-a"] = 0
    for gpus in ([None], ["GPU-a", None], ["GPU-b"], ["GPU-of-another-host"]):
        assert joules_counter(gpus) is None
    monkeypatch.setitem(sys.modules, "pynvml", None)
    assert joules_counter(["GPU-a"]) is None
    assert capfd.readouterr() == ("", "")


def test_a_stopwatch_counts_no_joules_of_pauses():
    meter = [100.0]
    clock = Stopwatch(lambda: meter[0])
    meter[0] += 7
    assert clock.joules == 7
    with clock.paused("scoring"):
        meter[0] += 1000
        with clock.paused("saving"):
            meter[0] += 500
        assert clock.joules == 7
    meter[0] += 3
    assert clock.joules == 10
    meter[0] = math.nan
    assert clock.joules is None and Stopwatch().joules is None


def _joules(folder: Path) -> list[float | None]:
    return [record.get("joules") for record in json.loads((folder / "train_log.json").read_text())]


def test_a_log_adds_those_of_the_runs_that_it_resumes(tmp_path):
    log = TrainingLog(tmp_path, 0)
    log.add(5, 1.0, 20.04)
    log.add(5, 1.0, loss=0.5)  # the same moment, without a reading
    again = TrainingLog(tmp_path, 5)
    again.add(9, 1.0, 30.0)
    assert _joules(tmp_path) == [20.0, 50.0] and training_joules(tmp_path, 9) == 50

    rescued = TrainingLog(tmp_path, 9)  # its curve has a later row, whose joules nobody knows
    rescued.not_before({"seconds": 3.0, "wall_seconds": None})
    rescued.add(10, 1.0, 4.0)
    unknown = TrainingLog(tmp_path, 10)
    unknown.add(11, 1.0, 4.0)
    assert _joules(tmp_path) == [20.0, 50.0, None, None] and training_joules(tmp_path, 11) is None


def test_a_training_writes_its_joules_where_they_are_known(colmap_scene, tmp_path, monkeypatch):
    words = ["-s", str(colmap_scene), "--iterations", "4", "--checkpoint_iterations", "2", "--disable_viewer", "--eval"]
    train.main([*words, "-m", str(tmp_path / "without")])
    assert _joules(tmp_path / "without") == [None, None]

    reads = iter(range(1000))
    counter = "splatting.run.joules_counter"
    monkeypatch.setattr(counter, lambda gpus: (lambda: float(next(reads))) if gpus == [None] else None)
    train.main([*words, "-m", str(tmp_path / "with")])
    first, last = _joules(tmp_path / "with")
    assert 0 < first < last
