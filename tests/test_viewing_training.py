"""The viewer during a training: it draws within its share, does what the buttons ask for, and changes no byte."""

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("viser", reason="viser is not installed: pip install '.[viewer]'")

from rasterizer_tools import CPU_AND_GPU  # noqa: E402
from viser_client import Client  # noqa: E402
from waiting import wait_for  # noqa: E402

import train  # noqa: E402
from scene.gaussians.checkpoint import load_checkpoint  # noqa: E402
from training.observers import page as observed  # noqa: E402
from utils.system_utils import UserError  # noqa: E402

ITERATIONS = 120


@pytest.fixture(autouse=True)
def _stdout(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", sys.stdout)  # training stamps it


class Watched:
    """A training whose observer tests can reach. acts: what is done in iterations, before anything else of them.

    frames: iteration and mode of each frame. paused: the iterations in which it has waited.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, acts: dict[int, Callable[["Watched"], None]]) -> None:
        self.frames: list[tuple[int, str]] = []
        self.paused: list[int] = []
        self.clients: list[Client] = []
        watched = self

        class Observer(observed.PageObserver):
            def __init__(self, *given: object) -> None:
                super().__init__(*given)
                watched.observer, watched.page, watched.requests = self, self._page, self._requests

            def due(self, step) -> bool:
                if step.iteration in acts:
                    acts[step.iteration](watched)
                return super().due(step)

            def _draw(self, wish, version) -> None:
                watched.frames.append((version, self._page.view.mode.value))
                super()._draw(wish, version)

            def _show_numbers(self, iteration) -> None:
                super()._show_numbers(iteration)
                if self._requests.paused and iteration not in watched.paused:
                    watched.paused.append(iteration)

            def ended(self, error) -> None:
                for client in watched.clients:
                    client.__exit__()
                super().ended(error)

        monkeypatch.setattr("training.observers.standard.PageObserver", Observer)

    def connect(self) -> None:
        """Let a browser look."""
        self.clients.append(Client(self.page.url))
        self.look()

    def look(self, x: float = 0.0) -> None:
        """Let the browser move its camera, and wait until that is known."""
        self.clients[-1].look((x, 0.0, -4.0))
        wait_for(lambda: [w.pose.position[0] for w in self.page.watchers._watchers.values()] == [pytest.approx(x)])

    def pause(self, *acts: Callable[[], object]) -> None:
        """Pause, and do one thing in each iteration that the training then waits in, from another thread."""
        self.requests.pause()

        def play() -> None:
            try:
                for number, act in enumerate(acts):
                    wait_for(lambda number=number: len(self.paused) > number)
                    act()
            except BaseException:
                self.requests.resume()  # so that the test ends
                raise

        threading.Thread(target=play).start()


def _train(scene: Path, out: Path, *options: object, viewer: bool = True) -> Path:
    words = ["-s", scene, "-m", out, "-r", 24, "--iterations", ITERATIONS, "--eval", "--densify_from_iter", 20,
             "--densification_interval", 20, "--densify_grad_threshold", 1e-6, *options]  # fmt: skip
    train.main([*map(str, words), *(["--viewer", "0"] if viewer else [])])
    return out / f"point_cloud/iteration_{ITERATIONS}/point_cloud.ply"


def _after(seconds: float, *calls: Callable[[], object]) -> Callable[[], None]:
    """Does something after so many seconds at least."""
    return lambda: (time.sleep(seconds), *(call() for call in calls))


@CPU_AND_GPU
@pytest.mark.parametrize("plain", [[], ["--plain_step"]])
def test_watching_changes_no_byte_of_the_model(colmap_scene, tmp_path, monkeypatch, plain, device):
    expected = _train(colmap_scene, tmp_path / "alone", *plain, viewer=False).read_bytes()

    def connect(watched: Watched) -> None:
        watched.observer.budget.allows = lambda share: True  # so that each mode gets its frames, however slow they are
        watched.connect()

    def look_at(mode: str, **more: object) -> Callable[[Watched], None]:
        def act(watched: Watched) -> None:
            watched.page.view.mode.value = mode
            for name, value in more.items():
                getattr(watched.page.view, name).value = value
            watched.look(0.1 * len(watched.frames))

        return act

    def pause(watched: Watched) -> None:
        watched.pause(_after(0.2, watched.requests.step), watched.requests.resume)

    acts = {10: connect, 15: look_at("Depth"), 25: look_at("Gaussians a pixel", scaling=0.5), 60: pause}
    acts |= {40: look_at("Colour", crop=True, degree=0), 80: look_at("Opacity"), 100: lambda w: w.requests.save()}
    watched = Watched(monkeypatch, acts)
    assert _train(colmap_scene, tmp_path / "watched", *plain).read_bytes() == expected
    assert {mode for _, mode in watched.frames} == {"Depth", "Gaussians a pixel", "Colour", "Opacity"}
    assert {15, 25, 40, 80} <= {iteration for iteration, _ in watched.frames} and watched.paused == [60, 61]
    log = json.loads((tmp_path / "watched/train_log.json").read_text())
    assert log[-1]["viewing_seconds"] > 0.15  # the pause: no time of training
    assert (tmp_path / "watched/chkpnt100.pth").exists()


def test_nothing_is_drawn_while_nobody_looks(colmap_scene, tmp_path, monkeypatch):
    asked = []
    watched = Watched(
        monkeypatch, {5: lambda w: monkeypatch.setattr(w.page.watchers, "next", lambda *_: asked.append(1))}
    )
    _train(colmap_scene, tmp_path / "out", "--no_curve")
    assert not watched.frames and not asked
    assert "viewing_seconds" not in json.loads((tmp_path / "out/train_log.json").read_text())[-1]


def test_a_paused_training_waits_takes_single_steps_and_goes_on(colmap_scene, tmp_path, monkeypatch):
    reached: list[int] = []

    def drive(watched: Watched) -> None:
        def note() -> None:
            reached.append(int(watched.page.iteration.value))

        step, resume = watched.requests.step, watched.requests.resume
        watched.pause(_after(0.3, note, step), _after(0.3, note, step), _after(0.3, note, resume))

    watched = Watched(monkeypatch, {10: Watched.connect, 30: drive})
    _train(colmap_scene, tmp_path / "out", "--no_curve")
    assert reached == watched.paused == [30, 31, 32]


def test_a_pause_does_not_make_the_training_look_slow(colmap_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(observed, "_NUMBERS_EVERY", 0.0)
    seen: list[float] = []

    def pause(watched: Watched) -> None:
        watched.pause(_after(0.3, watched.requests.resume))

    def note(watched: Watched) -> None:
        seen.append(float(watched.observer._tab.speed.value))

    watched = Watched(monkeypatch, {2: Watched.connect, 29: note, 30: pause, 31: note, 32: note})
    _train(colmap_scene, tmp_path / "out", "--no_curve")
    assert len(seen) == 3 and min(seen) > 0 and watched.paused == [30]


def test_stop_saves_a_checkpoint_that_can_be_resumed(colmap_scene, tmp_path, monkeypatch, capfd):
    Watched(monkeypatch, {33: lambda w: w.requests.stop()})
    with pytest.raises(KeyboardInterrupt):
        _train(colmap_scene, tmp_path / "out", "--no_curve")
    assert load_checkpoint(str(tmp_path / "out/chkpnt33.pth"), "cpu")[1] == 33
    assert "resume with --start_checkpoint" in capfd.readouterr().err
    monkeypatch.undo()
    monkeypatch.setattr(sys, "stdout", sys.stdout)
    resumed = _train(colmap_scene, tmp_path / "out", "--start_checkpoint", tmp_path / "out/chkpnt33.pth", viewer=False)
    assert resumed.read_bytes() == _train(colmap_scene, tmp_path / "alone", viewer=False).read_bytes()


def test_a_pause_before_the_stop_is_no_time_of_training(colmap_scene, tmp_path, monkeypatch):
    before: list[float] = []
    leap, clock = [0.0], time.perf_counter
    monkeypatch.setattr("records.training_log.running_seconds", lambda: clock() + leap[0])

    def pause(watched: Watched) -> None:
        before.append(watched.observer._run.clock.seconds)

        def stop() -> None:
            leap[0] = 1000.0  # seconds
            watched.requests.stop()

        watched.pause(stop)

    Watched(monkeypatch, {12: pause})
    with pytest.raises(KeyboardInterrupt):
        _train(colmap_scene, tmp_path / "out", "--no_curve")
    log = json.loads((tmp_path / "out/train_log.json").read_text())
    assert before[0] < log[-1]["seconds"] < before[0] + 500


def test_a_signal_ends_a_paused_training_and_saves_it(colmap_scene, tmp_path, monkeypatch):
    Watched(monkeypatch, {12: lambda watched: watched.pause(lambda: os.kill(os.getpid(), signal.SIGINT))})
    with pytest.raises(KeyboardInterrupt):
        _train(colmap_scene, tmp_path / "out", "--no_curve")
    assert (tmp_path / "out/chkpnt12.pth").exists()


def test_a_checkpoint_that_cannot_be_written_ends_no_training(colmap_scene, tmp_path, monkeypatch, capfd):
    told = []

    def save(watched: Watched) -> None:
        watched.page.tell = lambda title, body: told.append((title, body))
        watched.requests.save()

    Watched(monkeypatch, {10: save, 20: lambda watched: watched.requests.save()})
    (tmp_path / "out/chkpnt10.pth").mkdir(parents=True)
    expected = _train(colmap_scene, tmp_path / "alone", "--no_curve", viewer=False).read_bytes()
    assert _train(colmap_scene, tmp_path / "out", "--no_curve").read_bytes() == expected
    assert (tmp_path / "out/chkpnt20.pth").is_file()
    assert [title for title, _ in told] == ["Not saved", "Saved", "The training is done"]
    assert "warning: cannot write" in capfd.readouterr().err


def test_a_frame_that_cannot_be_drawn_ends_no_training(colmap_scene, tmp_path, monkeypatch, capfd):
    watched = Watched(monkeypatch, {5: Watched.connect})

    def broken(*_: object) -> None:
        raise RuntimeError("no memory for a frame")

    monkeypatch.setattr("viewing.frames.Frames.draw", broken)
    assert _train(colmap_scene, tmp_path / "out", "--no_curve").exists()
    assert watched.frames and capfd.readouterr().err.count("no memory for a frame") == 1


def test_the_curve_and_the_numbers_grow(colmap_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(observed, "_NUMBERS_EVERY", 0.0)
    seen: Iterator[tuple[int, ...]] = []

    def note(watched: Watched) -> None:
        seen.append((int(watched.page.iteration.value), len(watched.observer._tab.curve.data[0])))

    watched = Watched(monkeypatch, {2: Watched.connect, 60: note, 115: note})
    _train(colmap_scene, tmp_path / "out", "--test_iterations", *range(10, 120, 10))
    assert [iteration for iteration, _ in seen] == [59, 114]
    assert 1 < seen[0][1] < seen[1][1]
    tab = watched.observer._tab
    seconds, psnr = tab.curve.data
    assert (seconds[1:] >= seconds[:-1]).all() and tab.curve.visible and 5 < psnr.mean() < 60
    assert float(tab.loss.value) > 0 and float(tab.speed.value) > 0


def test_a_wrong_address_is_refused_before_a_file_is_written(colmap_scene, tmp_path):
    with pytest.raises(UserError, match="cannot listen"):
        _train(colmap_scene, tmp_path / "out", "--viewer_host", "no.such.host.invalid")
    assert not (tmp_path / "out").exists()
