"""The remote viewer of a training: a client written from the protocol watches, pauses, misbehaves; nothing changes."""

import os
import re
import signal
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from rasterizer_tools import CPU_AND_GPU
from trainings import train_on, whole_result
from viewer_client import Viewer, as_bytes, packed, request
from waiting import LIMIT, wait_for

import train
from arguments.features import FEATURES, Options
from arguments.launch import launch_options
from gaussian_renderer import network_gui, network_transfer, render
from gaussian_renderer.free_view import free_view
from scene.cameras import MiniCam
from splatting.part import Part

ITERATIONS = 60
OPTIONS = (), ("--train_test_exp", "--antialiasing", "-w", "--random_background", "--convert_SHs_python")
RESET = struct.pack("ii", 1, 0)  # of SO_LINGER: closing drops what is on its way


@pytest.fixture(autouse=True)
def _tidy(monkeypatch: pytest.MonkeyPatch) -> None:
    # A busy machine may keep a viewer of these tests from the next byte for longer than the real limits.
    monkeypatch.setattr(network_transfer, "SILENCE", LIMIT)
    monkeypatch.setattr(network_transfer, "LONGEST", LIMIT)
    yield
    network_gui.close()


def trained(scene: Path, out: Path, *options: object) -> dict[str, bytes | list]:
    words = "--eval", "-r", 48, "--iterations", ITERATIONS, "--test_iterations", -1, "--densify_from_iter", 10
    words += "--densification_interval", 20, "--opacity_reset_interval", 30, "--no_curve"
    train_on(scene, out, *words, "--checkpoint_iterations", ITERATIONS, *options)
    return whole_result(out, ITERATIONS)


def valid(**changes: object) -> dict[str, object]:
    return request(free_view(24, 16, 0.8, (0.0, 0.0, -3.0), (1.0, 0.0, 0.0, 0.0), "cpu"), **changes)


def answered(viewer: Viewer) -> str:
    """The path of an answer to `valid`, whose frame has come whole."""
    assert len(viewer.take(3 * 24 * 16)) == 3 * 24 * 16
    return viewer.path()


class Watched(Part):
    """A training that a viewer has paused in its first iteration. script: called with that in a thread of its own.

    stops: iterations in which training waits for `go`, so that the script does not have to hurry.
    """

    def __init__(self, script: Callable[["Watched", Viewer], object], stops: tuple[int, ...] = ()) -> None:
        self.script, self.stops = script, stops
        self.iteration = 0
        self._go = threading.Event()
        self._started, self._connected, self._run_training = threading.Event(), threading.Event(), train.run_training

    def _train(self, run: object, observers: list[Part]) -> None:
        self.run = run
        self._started.set()
        assert self._connected.wait(LIMIT)
        self._run_training(run, [*observers, self])

    def due(self, step: object) -> bool:
        self.iteration = step.iteration
        if step.iteration in self.stops:
            assert self._go.wait(LIMIT)
            self._go.clear()
        return False

    def reaches(self, iteration: int) -> None:
        wait_for(lambda: self.iteration == iteration)

    def go(self) -> None:
        self._go.set()

    def __call__(self, *words: object) -> dict[str, bytes | list]:
        """Train with words as `trained`, at a free port; the errors of the script are raised."""
        with ThreadPoolExecutor(1) as pool, pytest.MonkeyPatch.context() as patch:
            patch.setattr(train, "run_training", self._train)
            done = pool.submit(self._play)
            try:
                result = trained(*words, "--port", 0)
            finally:
                self._started.set()
                done.result(2 * LIMIT)
        return result

    def _play(self) -> None:
        assert self._started.wait(LIMIT)
        viewer = Viewer(network_gui.port)
        viewer.say(valid())
        self._connected.set()
        try:
            assert answered(viewer) == self.run.dataset.source_path
            self.script(self, viewer)
        finally:
            viewer.leave()

    def camera(self, number: int) -> MiniCam:
        """One of many views of the model."""
        return free_view(48, 32, 0.8, (0.02 * number, 0.0, -3.0), (1.0, 0.0, 0.0, 0.0), self.run.background.device)

    def check(self, viewer: Viewer, number: int, **changes: object) -> bytes:
        """Ask for a frame, training being paused; it must be what `render` shows of the model now."""
        run, camera = self.run, self.camera(number)
        switches = {"shs_python": int(run.pipe.convert_SHs_python)} | changes
        frame, path = viewer.ask(request(camera, **switches))
        with torch.no_grad():
            scaling = changes.get("scaling_modifier", 1.0)
            drawn = render(camera, run.gaussians, run.pipe, run.background, scaling)["render"]
        assert path == str(run.dataset.source_path) and frame.tobytes() == as_bytes(drawn).tobytes()
        return frame.tobytes()


@CPU_AND_GPU
@pytest.mark.parametrize("options", OPTIONS)
def test_frames_are_those_of_render_and_training_is_the_same(colmap_scene, tmp_path, options, device):
    count = 20 if not options else 5

    def script(watched: Watched, viewer: Viewer) -> None:
        first = [watched.check(viewer, number) for number in range(count)]  # paused
        assert len({*first}) == count and watched.iteration == 1
        small = watched.check(viewer, 0, scaling_modifier=0.3)
        assert small != first[0]
        text = packed(valid())
        for start in range(0, len(text), 100):  # in pieces
            viewer.socket.sendall(text[start : start + 100])
            time.sleep(0.01)
        answered(viewer)
        viewer.ask(request(watched.camera(0), train=1))
        watched.reaches(25)  # nothing is asked for: training does not wait
        viewer.say(valid())
        watched.go()
        answered(viewer)
        later = watched.check(viewer, 0)
        assert later != first[0] and watched.iteration == 26
        viewer.ask(request(watched.camera(1), train=1, shs_python=1, rot_scale_python=1))
        viewer.leave()

    watched = Watched(script, stops=(25,))
    result = watched(colmap_scene, tmp_path / "watched", *options)
    assert watched.iteration == ITERATIONS
    assert result == trained(colmap_scene, tmp_path / "alone", "--disable_viewer", *options)
    record = (tmp_path / "watched/train_log.json").read_text()
    assert '"viewing_seconds"' in record and '"viewing_seconds"' not in (tmp_path / "alone/train_log.json").read_text()


def leave_amid(viewer: Viewer) -> None:
    """Ask for a large frame, take a piece of it, and go."""
    viewer.say(valid(resolution_x=1600, resolution_y=1600))
    viewer.take(1000)
    viewer.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
    viewer.leave()


def take_nothing(viewer: Viewer) -> None:
    """Ask for a frame that the system does not keep, and wait for the end of the connection without taking it."""
    network_gui.conn.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    viewer.say(valid(resolution_x=1600, resolution_y=1600))
    own = viewer.socket.getsockname()
    wait_for(lambda: network_gui.addr != own)
    viewer.leave()


# What a viewer does once it has paused training, and why it is let go; test_network_message.py has all of its requests.
HOSTILE: dict[str, tuple[Callable[[Viewer], None] | bytes, str]] = {
    "2 GB": (struct.pack("<i", 2**31 - 1), "announced a message of 2,147,483,647 bytes"),
    "half a message": (packed(valid())[:200], "silent"),
    "not JSON": (packed(b"GET / HTTP/1.1\r\n\r\n"), "not JSON"),
    "wrong types": (packed(valid(fov_x="1", view_matrix={"a": 1})), "fov_x is not a number"),
    "left in a frame": (leave_amid, "reset|pipe"),
    "takes nothing": (take_nothing, "silent"),
}


def test_no_message_ends_the_training(colmap_scene, tmp_path, capfd):
    """Each viewer is connected before the one before it is let go, so that each meets a training."""

    def script(watched: Watched, viewer: Viewer) -> None:
        for act, why in HOSTILE.values():
            following = Viewer(network_gui.port, buffer=4096)
            following.say(valid())
            with pytest.MonkeyPatch.context() as limited:
                if why == "silent":
                    limited.setattr(network_transfer, "SILENCE", 0.3)
                if isinstance(act, bytes):
                    viewer.socket.sendall(act)
                else:
                    act(viewer)
                assert viewer.socket.fileno() < 0 or viewer.is_let_go()
            viewer.leave()
            viewer = following
            assert answered(viewer) == str(colmap_scene)
        assert watched.iteration < ITERATIONS
        viewer.ask(valid(train=1))
        viewer.leave()

    watched = Watched(script)
    result = watched(colmap_scene, tmp_path / "watched")
    said = [line for line in capfd.readouterr().err.splitlines() if "is disconnected" in line]
    assert len(said) == len(HOSTILE)
    for line, (name, (_, why)) in zip(said, HOSTILE.items(), strict=True):
        assert re.search(rf"viewer 127.0.0.1:\d+ is disconnected: .*({why})", line), name
    assert result == trained(colmap_scene, tmp_path / "alone", "--disable_viewer")


@pytest.fixture
def _interruptible() -> Iterator[None]:
    """Ctrl-C interrupts, also where the tests were started in the background of a shell, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("end", ["lets go", "Ctrl-C"])
@pytest.mark.usefixtures("_interruptible")
def test_keep_alive_holds_a_finished_training(colmap_scene, tmp_path, capsys, end):
    out = tmp_path / "out"

    def script(watched: Watched, viewer: Viewer) -> None:
        viewer.ask(request(watched.camera(0), train=1, keep_alive=1))
        watched.reaches(ITERATIONS - 1)
        viewer.say(valid(train=1, keep_alive=1))  # there in the last iteration, and answered after it
        watched.go()
        answered(viewer)
        assert (out / f"chkpnt{ITERATIONS}.pth").exists()
        for number in range(3):
            watched.check(viewer, number, train=1, keep_alive=1)
        time.sleep(0.3)
        assert (out / f"point_cloud/iteration_{ITERATIONS}/point_cloud.ply").exists()
        watched.check(viewer, 3, train=0, keep_alive=0)
        watched.check(viewer, 4, train=1, keep_alive=1)
        if end == "lets go":
            watched.check(viewer, 5, train=1, keep_alive=0)
        else:
            os.kill(os.getpid(), signal.SIGINT)
        assert viewer.is_let_go()

    watched = Watched(script, stops=(ITERATIONS - 1,))
    if end == "Ctrl-C":
        with pytest.raises(KeyboardInterrupt):
            watched(colmap_scene, out)
    else:
        watched(colmap_scene, out)
        assert "Training complete." in capsys.readouterr().out


@pytest.mark.parametrize("address", [("127.0.0.1", None), ("127.0.0.1", 70_000), ("::no", 0)])
def test_an_address_that_cannot_be_had_is_one_warning(address, capfd):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        host, port = address[0], taken.getsockname()[1] if address[1] is None else address[1]
        network_gui.init(host, port)
    assert network_gui.listener is None and (network_gui.host, network_gui.port) == (host, port)
    (warning,) = capfd.readouterr().err.splitlines()
    assert warning.startswith(f"warning: cannot listen at {host}:{port} (") and "concerns only the viewer" in warning
    assert warning.endswith("(SIBR); give --disable_viewer to silence this, or --port 0 for any free port")
    network_gui.try_connect()
    assert network_gui.conn is None


def test_a_second_training_says_nothing_of_a_port_that_nobody_chose(colmap_scene, tmp_path, monkeypatch, capfd):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        ip, given, switch = FEATURES["remote_viewer"].launch
        for default, warnings in ((port, 0), (1, 1)):
            options = Options(launch=(ip, replace(given, default=default), switch))
            monkeypatch.setitem(FEATURES, "remote_viewer", options)
            train_on(colmap_scene, tmp_path / f"{warnings}", "--iterations", 1, "--port", port, "-r", 48)
            assert capfd.readouterr().err.count("cannot listen at") == warnings


def test_disable_viewer_opens_nothing_and_the_default_address_is_the_reference_s(colmap_scene, tmp_path, monkeypatch):
    opened = []
    monkeypatch.setattr(socket, "create_server", lambda *x, **y: opened.append(x))
    train_on(colmap_scene, tmp_path / "out", "--iterations", 1, "--disable_viewer", "-r", 48)
    args = train.parse(["-s", "."])[0]
    assert opened == [] and (args.ip, args.port, args.disable_viewer) == ("127.0.0.1", 6009, False)
    assert launch_options().disable_viewer  # as a call of the reference's `training` opens nothing


# Loops that call the names of the reference themselves


def _next_viewer() -> Viewer:
    """A viewer that is connected to a loop of its own."""
    viewer = Viewer(network_gui.port)
    wait_for(lambda: network_gui.try_connect() or network_gui.conn)
    return viewer


def test_a_loop_of_its_own_receives_and_sends(monkeypatch, capfd):
    monkeypatch.setattr(network_gui, "PATIENCE", 0.3)
    network_gui.init("127.0.0.1", 0)
    network_gui.try_connect()
    assert network_gui.conn is None
    dropped = _next_viewer()
    network_gui.conn = None
    assert dropped.is_let_go()
    viewer = _next_viewer()
    viewer.say(valid(train=1, shs_python=1, scaling_modifier=0.25))
    camera, *rest = network_gui.receive()
    assert rest == [True, True, False, False, 0.25] and (camera.image_width, camera.image_height) == (24, 16)
    network_gui.send(memoryview(bytes(3 * 24 * 16)), "/scène\udcff")  # a name that is not UTF-8
    assert viewer.take(3 * 24 * 16) == bytes(3 * 24 * 16)
    assert viewer.take(12) == struct.pack("<I", 8) + "/scène".encode() + b"\xff"
    viewer.say({"resolution_x": 0, "resolution_y": 0})
    assert network_gui.receive() == (None,) * 6
    network_gui.send(None, "/scene")
    assert viewer.path() == "/scene"
    viewer.say(valid())
    assert network_gui.read() == valid()
    with pytest.raises(Exception, match="sent nothing for 0.3 s"):
        network_gui.receive()
    assert network_gui.conn is None and viewer.is_let_go()
    assert capfd.readouterr().err.count("\n") == 1
