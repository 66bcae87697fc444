"""The viewer during a training: it draws within its share, does what the buttons ask for, and changes no byte."""

import json
import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
import torch

pytest.importorskip("viser", reason="viser is not installed: pip install '.[viewer]'")

from rasterizer_tools import CPU_AND_GPU  # noqa: E402
from viser_client import Client  # noqa: E402
from waiting import wait_for  # noqa: E402

import train  # noqa: E402
from scene.gaussians.checkpoint import load_checkpoint  # noqa: E402
from scene.saved_model import read_model  # noqa: E402
from splatting.parts.viewer import training_page as observed  # noqa: E402
from splatting.viewer import training_tab  # noqa: E402
from splatting.viewer.page import serve  # noqa: E402
from utils.system_utils import UserError  # noqa: E402

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

    acts = {10: connect, 15: look_at("Depth"), 25: look_at("Gaussians per pixel", scaling=0.5), 60: pause}
    acts |= {40: look_at("Colour", crop=True, degree=0), 80: look_at("Opacity"), 100: lambda w: w.requests.save()}
    watched = Watched(monkeypatch, acts)
    assert _train(colmap_scene, tmp_path / "watched", *plain).read_bytes() == expected
    assert {mode for _, mode in watched.frames} == {"Depth", "Gaussians per pixel", "Colour", "Opacity"}
    assert {15, 25, 40, 80} <= {iteration for iteration, _ in watched.frames} and watched.paused == [60, 61]
    log = json.loads((tmp_path / "watched/train_log.json").read_text())
    assert log[-1]["viewing_seconds"] > 0.15  # the pause: no time of training
    assert (tmp_path / "watched/chkpnt100.pth").exists()


def test_nothing_is_drawn_while_nobody_looks(colmap_scene, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr("splatting.viewer.watchers.Watchers.next", lambda *_: asked.append(1))
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


def test_a_training_can_begin_paused(colmap_scene, tmp_path, monkeypatch):
    """Its bytes are those of one that does not."""
    _train(colmap_scene, tmp_path / "plain", "--no_curve", viewer=False)
    labels = []

    def begin(watched: Watched) -> None:
        labels.append(watched.observer._tab.pause.label)
        threading.Thread(target=_after(0.2, lambda: wait_for(lambda: watched.paused), watched.requests.resume)).start()

    watched = Watched(monkeypatch, {1: begin})
    _train(colmap_scene, tmp_path / "out", "--no_curve", "--paused")
    assert watched.paused == [1] and labels == ["Resume"]
    plys = [folder / "point_cloud/iteration_120/point_cloud.ply" for folder in (tmp_path / "plain", tmp_path / "out")]
    assert plys[0].read_bytes() == plys[1].read_bytes()


def test_a_pause_needs_a_page(colmap_scene, tmp_path):
    with pytest.raises(UserError, match="--paused needs --viewer"):
        train.main(["-s", str(colmap_scene), "-m", str(tmp_path / "out"), "--paused", "--iterations", "2"])
    assert not (tmp_path / "out").exists()


def test_time_to_go_is_that_of_the_clock_or_of_the_speed():
    def page(**schedule: object) -> SimpleNamespace:
        run = SimpleNamespace(
            schedule=SimpleNamespace(by_clock=False, expected=None) ,
            log=SimpleNamespace(seconds_before=5.0), clock=SimpleNamespace(seconds=12.0),
        )  # fmt: skip
        vars(run.schedule).update(schedule)
        return SimpleNamespace(_run=run)

    left = observed.TrainingPage._left
    assert left(page(expected=1000), 400, 20.0) == 30 and left(page(expected=1000), 400, None) is None
    assert left(page(), 400, 20.0) is None
    assert left(page(by_clock=True, until=60.0), 400, None) == 43
    said = [training_tab.duration(seconds) for seconds in (0.4, 59.6, 200, 7500)]
    assert said == ["0 s", "1 min 0 s", "3 min 20 s", "2 h 5 min"]


@pytest.mark.parametrize("end", ["stop", "signal"])
def test_a_paused_training_that_ends_is_saved_and_the_pause_is_no_time_of_it(colmap_scene, tmp_path, monkeypatch, end):
    before: list[float] = []
    leap, clock = [0.0], time.perf_counter
    monkeypatch.setattr("splatting.evaluation.training_log.running_seconds", lambda: clock() + leap[0])

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


def test_a_training_that_the_page_stops_can_be_looked_at(colmap_scene, tmp_path, monkeypatch, capfd):
    watched = _Staying(monkeypatch, {33: lambda w: w.requests.stop()}, _Staying.look_and_close)
    with pytest.raises(KeyboardInterrupt, match="stopped from the page"):
        _train(colmap_scene, tmp_path / "out", "--no_curve")
    assert watched.seen[0].std() > 5 and watched.page.iteration.value == "33 of 120"
    assert f"saved as {tmp_path / 'out/chkpnt33.pth'}" in watched.observer._tab.state.content
    assert load_checkpoint(str(tmp_path / "out/chkpnt33.pth"))[1] == 33
    assert "with --start_checkpoint" in capfd.readouterr().err


def test_a_signal_ends_the_page_of_a_training_that_is_over(colmap_scene, tmp_path, monkeypatch):
    def visit(watched: _Staying) -> None:
        watched.picture()  # now it is served
        os.kill(os.getpid(), signal.SIGINT)
        wait_for(lambda: watched.ends)

    watched = _Staying(monkeypatch, {}, visit)
    _train(colmap_scene, tmp_path / "out", "--no_curve")  # and goes on as after any training
    assert watched.ends == [KeyboardInterrupt]


def test_a_signal_that_ends_the_training_ends_the_page(colmap_scene, tmp_path, monkeypatch):
    watched = _Staying(monkeypatch, {33: lambda w: os.kill(os.getpid(), signal.SIGINT)}, lambda _: None)
    with pytest.raises(KeyboardInterrupt):
        _train(colmap_scene, tmp_path / "out", "--no_curve")
    assert not watched.seen
    with pytest.raises(OSError):
        Client(watched.page.url)


def test_neither_a_checkpoint_nor_a_frame_that_fails_ends_a_training(colmap_scene, tmp_path, monkeypatch, capfd):
    told = []

    def save(watched: Watched) -> None:
        watched.page.notify = lambda title, body, color=None: told.append((title, color))
        watched.requests.save()

    def broken(*_: object) -> None:
        raise RuntimeError("no memory for a frame")

    watched = Watched(monkeypatch, {5: Watched.connect, 10: save, 20: save})
    monkeypatch.setattr("splatting.viewer.frames.Frames.draw", broken)
    (tmp_path / "out/chkpnt10.pth").mkdir(parents=True)
    expected = _train(colmap_scene, tmp_path / "alone", "--no_curve", viewer=False).read_bytes()
    assert _train(colmap_scene, tmp_path / "out", "--no_curve").read_bytes() == expected
    assert (tmp_path / "out/chkpnt20.pth").is_file() and watched.frames
    assert told == [("Not saved", "red"), ("Saved", None), ("The training is over", None)]
    said = capfd.readouterr().err
    assert "warning: cannot write" in said and said.count("no memory for a frame") == 1


def test_points_of_some_test_views_are_called_so():
    tab = training_tab.TrainingTab(mock.MagicMock(), mock.MagicMock())
    rows = [{"seconds": s, "test_psnr": p} for s, p in ((1.0, 20.0), (2.0, 25.0))]
    tab.show(None, None, 0.1, rows, 4)
    assert [values.tolist() for values in tab.curve.data] == [[1.0, 2.0], [20.0, 25.0]]
    assert tab.note.content == "Points score 4 of the test views." and tab.note.visible
    tab.show(None, None, 0.1, [*rows, {"seconds": 3.0, "test_psnr": 26.0}], None)
    assert len(tab.curve.data[0]) == 3 and not tab.note.visible


def test_a_wrong_port_is_refused_before_a_file_is_written(colmap_scene, tmp_path):
    with pytest.raises(UserError, match="between 0"):
        _train(colmap_scene, tmp_path / "out", "--viewer", "70000", viewer=False)
    assert not (tmp_path / "out").exists()
