"""The viewer during a training: it draws within its share, does what the buttons ask for, and changes no byte."""

import json
import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("viser", reason="viser is not installed: pip install '.[viewer]'")

from rasterizer_tools import CPU_AND_GPU  # noqa: E402
from viser_client import Client  # noqa: E402
from waiting import wait_for  # noqa: E402

import train  # noqa: E402
from applications.viewer import training_page as observed  # noqa: E402
from applications.viewer.page import serve  # noqa: E402
from scene.saved_model import read_model  # noqa: E402

ITERATIONS = 120


class Watched:
    """A training whose observer tests can reach. acts: what is done in iterations, before anything else of them.

    frames: iteration and mode of each frame. paused: the iterations in which it has waited.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, acts: dict[int, Callable[["Watched"], None]]) -> None:
        self.frames: list[tuple[int, str]] = []
        self.paused: list[int] = []
        self.clients: list[Client] = []
        watched = self

        class Page(observed.TrainingPage):
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

            def _show_numbers(self, iteration, paused=False) -> None:
                super()._show_numbers(iteration, paused)
                if paused and iteration not in watched.paused:
                    watched.paused.append(iteration)

            def ended(self, error) -> None:
                for client in watched.clients:
                    client.__exit__()
                super().ended(error)

        monkeypatch.setattr(observed, "TrainingPage", Page)
        monkeypatch.setattr(observed, "serve", lambda page: None)  # so that the test ends

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
def test_watching_changes_no_byte_of_the_model(colmap_scene, tmp_path, monkeypatch, device):
    expected = _train(colmap_scene, tmp_path / "alone", viewer=False).read_bytes()

    def connect(watched: Watched) -> None:
        watched.observer.budget.allows_frame = lambda share: True  # each mode gets its frames, however slow they are
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

    acts = {10: connect, 15: look_at("Depth"), 25: look_at("Gaussians per pixel", scaling=0.5), 60: pause}
    acts |= {40: look_at("Colour", crop=True, degree=0), 80: look_at("Opacity"), 100: lambda w: w.requests.save()}
    watched = Watched(monkeypatch, acts)
    assert _train(colmap_scene, tmp_path / "watched").read_bytes() == expected
    assert {mode for _, mode in watched.frames} == {"Depth", "Gaussians per pixel", "Colour", "Opacity"}
    assert {15, 25, 40, 80} <= {iteration for iteration, _ in watched.frames} and watched.paused == [60, 61]
    log = json.loads((tmp_path / "watched/train_log.json").read_text())
    assert log[-1]["viewing_seconds"] > 0.15  # the pause: no time of training
    assert (tmp_path / "watched/chkpnt100.pth").exists()


def test_nothing_is_drawn_while_nobody_looks(colmap_scene, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr("applications.viewer.watchers.Watchers.next", lambda *_: asked.append(1))
    watched = Watched(monkeypatch, {})
    _train(colmap_scene, tmp_path / "out", "--no_curve")
    assert not watched.frames and not asked
    assert "viewing_seconds" not in json.loads((tmp_path / "out/train_log.json").read_text())[-1]


def test_the_page_shows_how_the_training_goes(colmap_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(observed, "_NUMBERS_EVERY", 0.0)
    seen = []

    def note(watched: Watched) -> None:
        tab = watched.observer._tab
        iteration, _, total = watched.page.iteration.value.partition(" of ")
        assert total == "120" and tab.left.value.endswith(" s")
        seen.append((int(iteration), float(tab.speed.value), len(tab.curve.data[0])))

    watched = Watched(monkeypatch, {2: Watched.connect, 33: note, 34: note, 60: note, 115: note})
    _train(colmap_scene, tmp_path / "out", "--test_iterations", *range(10, 120, 10))
    iterations, speeds, points = zip(*seen, strict=True)
    assert iterations == (32, 33, 59, 114) and min(speeds) > 0 and 1 < points[2] < points[3]
    tab = watched.observer._tab
    seconds, psnr = tab.curve.data
    assert (seconds[1:] >= seconds[:-1]).all() and tab.curve.visible and 5 < psnr.mean() < 60 and float(tab.loss.value)
    assert not tab.left.visible and not tab.speed.visible  # it is over


def test_a_pause_from_the_start_and_faults_of_the_page_change_no_byte(colmap_scene, tmp_path, monkeypatch, capfd):
    told, labels = [], []

    def begin(watched: Watched) -> None:
        watched.page.notify = lambda title, body, color=None: told.append((title, color))
        labels.append(watched.observer._tab.pause.label)
        threading.Thread(target=_after(0.2, lambda: wait_for(lambda: watched.paused), watched.requests.resume)).start()

    def broken(*_: object) -> None:
        raise RuntimeError("no memory for a frame")

    def save(watched: Watched) -> None:
        watched.requests.save()

    watched = Watched(monkeypatch, {1: begin, 5: Watched.connect, 10: save, 20: save})
    monkeypatch.setattr("applications.viewer.frames.Frames.draw", broken)
    (tmp_path / "out/chkpnt10.pth").mkdir(parents=True)
    expected = _train(colmap_scene, tmp_path / "alone", "--no_curve", viewer=False).read_bytes()
    assert _train(colmap_scene, tmp_path / "out", "--no_curve", "--paused").read_bytes() == expected
    assert watched.paused == [1] and labels == ["Resume"] and watched.frames
    assert (tmp_path / "out/chkpnt20.pth").is_file()
    assert told == [("Not saved", "red"), ("Saved", None), ("The training is over", None)]
    said = capfd.readouterr().err
    assert "warning: cannot write" in said and said.count("no memory for a frame") == 1


@pytest.mark.parametrize("end", ["stop", "signal"])
def test_a_paused_training_that_ends_is_saved_and_the_pause_is_no_time_of_it(colmap_scene, tmp_path, monkeypatch, end):
    before: list[float] = []
    leap, clock = [0.0], time.perf_counter
    monkeypatch.setattr("splatting.records.training_log.running_seconds", lambda: clock() + leap[0])

    def pause(watched: Watched) -> None:
        before.append(watched.observer._run.clock.seconds)

        def stop() -> None:
            leap[0] = 1000.0  # seconds
            watched.requests.stop() if end == "stop" else os.kill(os.getpid(), signal.SIGINT)

        watched.pause(stop)

    Watched(monkeypatch, {12: pause})
    with pytest.raises(KeyboardInterrupt):
        _train(colmap_scene, tmp_path / "out", "--no_curve")
    log = json.loads((tmp_path / "out/train_log.json").read_text())
    assert before[0] < log[-1]["seconds"] < before[0] + 500
    assert (tmp_path / "out/chkpnt12.pth").exists()


class _Staying(Watched):
    """A training whose page stays. visit: what is done, in a thread of its own, when the training is over."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, acts: dict, visit: Callable[["_Staying"], object]) -> None:
        super().__init__(monkeypatch, acts)
        self.seen: list[object] = []
        self.ends: list[object] = []  # what `serve` has returned

        def staying(page) -> None:
            def call() -> None:
                try:
                    self.seen.append(visit(self))
                finally:
                    page.requests.stop()  # so that the test ends

            visitor = threading.Thread(target=call)
            visitor.start()
            self.ends.append(serve(page))
            visitor.join()

        monkeypatch.setattr(observed, "serve", staying)

    def picture(self) -> np.ndarray:
        with Client(self.page.url) as client:
            client.look((0.0, 0.0, -3.0))
            return client.picture()

    def look_and_close(self) -> np.ndarray:
        """The picture; then press the button."""
        picture = self.picture()
        tab = self.observer._tab
        assert tab.close.visible and not tab.pause.visible and not tab.note.visible
        with Client(self.page.url) as client:
            client.look()
            client.send("GuiUpdateMessage", uuid=tab.close._impl.uuid, updates={"value": True})
            wait_for(lambda: self.requests.stopped)
        return picture


def test_the_page_stays_after_its_training_and_shows_the_saved_model(colmap_scene, tmp_path, monkeypatch, capfd):
    def visit(watched: _Staying) -> tuple:
        return watched.page._gaussians, watched.look_and_close(), watched.page.count.value

    watched = _Staying(monkeypatch, {5: lambda w: w.requests.pause() or w.requests.resume()}, visit)
    # The last iteration is one of densification, after the model is saved.
    path = _train(colmap_scene, tmp_path / "out", "--no_curve")
    shown, picture, count = watched.seen[0]
    saved = read_model(path)
    assert len(watched.observer._run.gaussians) > len(saved) == len(shown) == int(count.replace(",", ""))
    assert torch.equal(shown.get_xyz, saved.get_xyz) and picture.std() > 5
    said = capfd.readouterr().err
    assert f"The page stays open at {watched.page.url}" in said


def test_a_signal_that_ends_the_training_ends_the_page(colmap_scene, tmp_path, monkeypatch):
    watched = _Staying(monkeypatch, {33: lambda w: os.kill(os.getpid(), signal.SIGINT)}, lambda _: None)
    with pytest.raises(KeyboardInterrupt):
        _train(colmap_scene, tmp_path / "out", "--no_curve")
    assert not watched.seen
    with pytest.raises(OSError):
        Client(watched.page.url)
