"""The training loop: the hooks of observers and of density control, each called in its place; and the progress bar."""

import io
import json
import time
from itertools import count
from types import SimpleNamespace

import pytest
from tqdm import tqdm

import train
from groundwork.host.progress import Bar, in_threads
from scene.gaussians.density_rules import Actions
from splatting.loop import standard_observers
from splatting.part import Part, Strategy

ITERATIONS = 24


@pytest.fixture(autouse=True)
def _without_bands(monkeypatch) -> None:
    """No raise of the SH degree is due in iterations as few as these."""
    monkeypatch.setattr("splatting.run.USUAL", 1)


class Recorder(Part):
    """Notes every hook with its iteration."""

    def __init__(self, told: list[tuple[str, int]], name: str = "", writes: tuple[int, ...] = ()) -> None:
        self._told = told
        self._name = name
        self._writes = writes

    def _note(self, hook: str, iteration: int) -> None:
        self._told.append((self._name + hook, iteration))

    def due(self, step) -> bool:
        self._note("due", step.iteration)
        return step.iteration in self._writes

    def measured(self, step, losses) -> None:
        assert losses.total.isfinite() and losses.l1.isfinite()
        self._note("measured" + " due" * step.due, step.iteration)

    def stepped(self, step) -> None:
        self._note("stepped", step.iteration)

    def ended(self, error) -> None:
        self._note("ended" if error is None else type(error).__name__, 0)


def _train(scene, out, monkeypatch, observers, *options: object) -> None:
    monkeypatch.setattr(train, "standard_observers", observers)
    words = ["-s", scene, "-m", out, "-r", 24, "--iterations", ITERATIONS, "--test_iterations", -1, *options]
    train.main(list(map(str, words)))


def test_every_hook_is_called_once_an_iteration_and_in_order(colmap_scene, tmp_path, monkeypatch):
    told = []
    _train(colmap_scene, tmp_path, monkeypatch, lambda *_: [Recorder(told, writes=(7,))],
           "--densify_from_iter", 5, "--densification_interval", 10)  # fmt: skip
    expected = []
    for t in range(1, ITERATIONS + 1):
        # The observer writes in 7; density control changes the Gaussians in 10 and 20.
        due = " due" if t in (7, 10, 20) else ""
        expected += [("due", t), ("measured" + due, t), ("stepped", t)]
    assert told == [*expected, ("ended", 0)]


def test_observers_are_told_in_the_order_of_the_list_and_of_the_error(colmap_scene, tmp_path, monkeypatch):
    told = []

    class Broken(Part):
        def stepped(self, step) -> None:
            if step.iteration == 2:
                raise RuntimeError("broken")

    def observers(*_) -> list[Part]:
        return [Recorder(told, "a "), Broken(), Recorder(told, "b ")]

    with pytest.raises(RuntimeError, match="broken"):
        _train(colmap_scene, tmp_path, monkeypatch, observers)
    hooks = ("due", "measured", "stepped")
    first = [(f"{name} {hook}", 1) for hook in hooks for name in "ab"]
    second = [(f"{name} {hook}", 2) for hook in hooks for name in "ab"][:-1]  # b is not told that 2 has stepped
    assert told == [*first, *second, ("a RuntimeError", 0), ("b RuntimeError", 0)]


def test_another_strategy_is_another_object(colmap_scene, tmp_path, monkeypatch):
    calls = []

    class Other(Strategy):
        name = "adc"

        def actions(self, iteration: int) -> Actions:
            return Actions(changes=iteration == 3)

        def after_backward(self, step, package) -> None:
            assert self._gaussians.get_xyz.grad is not None and package["radii"].any()
            calls.append(("after_backward", step.iteration))

        def after_step(self, step) -> None:
            assert self._gaussians.get_xyz.grad is None
            calls.append(("after_step", step.iteration))

    monkeypatch.setattr("splatting.make_run.strategy_part", lambda name: Other())
    told = []
    _train(colmap_scene, tmp_path, monkeypatch, lambda *_: [Recorder(told)])
    steps = range(1, ITERATIONS + 1)
    assert [t for hook, t in told if hook == "measured due"] == [3]
    # As in the reference, the last iteration takes no step.
    assert [t for hook, t in calls if hook == "after_backward"] == list(steps)
    assert [t for hook, t in calls if hook == "after_step"] == list(steps[:-1])


def test_what_replaces_training_report_is_called(colmap_scene, tmp_path, monkeypatch):
    """Programs that import train.py as a module put their own in its place. Its seconds are none of training."""
    reported, clock = [], time.perf_counter
    monkeypatch.setattr("splatting.records.training_log.running_seconds", lambda: clock() + 1000 * len(reported))

    def report(writer, iteration: int, *_: object) -> dict[str, float]:
        reported.append(iteration)
        return {"test_psnr": 30.0} if iteration == 4 else {}

    monkeypatch.setattr(train, "training_report", report)
    _train(colmap_scene, tmp_path, monkeypatch, standard_observers)
    assert reported == list(range(1, ITERATIONS + 1))
    records = json.loads((tmp_path / "train_log.json").read_text())
    assert [record["iteration"] for record in records if "test_psnr" in record] == [4]
    assert records[-1]["seconds"] < 500


# The progress bar of training


@pytest.mark.parametrize("seconds", [0.0, 4.0])
def test_a_log_gets_a_line_in_ten_seconds_and_a_last_one(monkeypatch, seconds):
    log, now = io.StringIO(), iter(count(0.0, seconds))
    monkeypatch.setattr("groundwork.host.progress.time", SimpleNamespace(monotonic=lambda: next(now)))
    for _ in Bar(range(30), file=log, desc="Looking", mininterval=0, miniters=1):
        tqdm.write("other", file=log)
    lines = [line for line in log.getvalue().split("\n") if line != "other"]
    assert lines[-1] == "" and lines[-2].startswith("Looking: 100%") and "\r" not in log.getvalue()
    assert "0%|  " not in lines[0] and len(lines) == (2 if not seconds else len(set(lines)))
    assert not seconds or 5 < len(lines) < 40

    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    for _ in Bar(range(3), file=(shown := Terminal())):
        pass
    assert "0%" in shown.getvalue() and "100%" in shown.getvalue()


def test_work_in_threads_is_one_line_of_a_log():
    log = io.StringIO()
    assert in_threads(lambda number: 2 * number, range(50), file=log, mininterval=0) == [*range(0, 100, 2)]
    assert log.getvalue().count("\n") == 1 and "\r" not in log.getvalue()
