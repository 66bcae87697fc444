"""The process that draws error_vs_time.png while the finished model is saved."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from records import curve_drawer, curve_recorder
from records.curve_drawer import CurveDrawer
from records.curve_recorder import CurveRecorder
from records.error_curve import COLUMNS, FIGURE, SUBSET
from records.training_log import TrainingLog

ROOT = Path(__file__).parents[1]
ROWS = [dict.fromkeys(COLUMNS) | {"iteration": t, "seconds": t / 10, "test_psnr": 10.0 + t} for t in (1, 2, 4)]


@pytest.fixture(autouse=True)
def without_matplotlib(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a training, which does not import it. Tests of this process may have."""
    for name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)


def _drawn(folder: Path, rows: list = ROWS) -> str | None:
    drawer = CurveDrawer()
    drawer.begin()
    drawer.begin()
    assert drawer._process is not None
    drawer.draw(folder / FIGURE, rows, "Füße")
    return drawer.finish()


def test_another_process_draws(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(curve_drawer, "draw_curve", lambda *_: pytest.fail("drawn here"))
    infinite = [*ROWS, ROWS[0] | {"iteration": 8, "seconds": 0.8, "test_psnr": float("inf")}]
    assert _drawn(Path(), infinite) is None
    with Image.open(tmp_path / FIGURE) as image:
        assert min(image.size) > 400
    assert [path.name for path in tmp_path.iterdir()] == [FIGURE]
    assert "matplotlib" not in sys.modules


def test_that_process_imports_no_torch():
    code = "import sys; import records.curve_drawer; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


def test_what_goes_wrong_there_is_told(tmp_path, monkeypatch):
    (tmp_path / FIGURE).mkdir()
    assert _drawn(tmp_path).startswith(f"UserError: cannot write {tmp_path / FIGURE} (")
    monkeypatch.setattr(curve_drawer.sys, "executable", "/nowhere/python")
    monkeypatch.setattr(curve_drawer, "draw_curve", lambda *_: 1 / 0)
    drawer = CurveDrawer()
    drawer.begin()  # cannot start, so it is drawn here
    drawer.draw(tmp_path / FIGURE, ROWS, "")
    assert drawer.finish() == "ZeroDivisionError: division by zero"


@pytest.mark.parametrize("given", [True, False])
def test_a_process_that_is_killed_is_told(tmp_path, given):
    drawer = CurveDrawer()
    drawer.begin()
    drawer._process.kill()
    drawer._process.wait()
    drawer.draw(tmp_path / FIGURE, ROWS * (1000 if given else 1), "")
    assert drawer.finish() == "the process that draws it ended with status -9"


def test_nothing_is_drawn_of_a_training_that_fails(tmp_path):
    drawer = CurveDrawer()
    drawer.abandon()  # none was started
    drawer.begin()
    process = drawer._process
    drawer.abandon()
    assert process.returncode is not None and list(tmp_path.iterdir()) == []


def test_its_input_may_end(tmp_path):
    """As when the training was killed."""
    done = subprocess.run(
        [sys.executable, "-m", "records.curve_drawer"], cwd=ROOT, input="", capture_output=True, text=True, check=True
    )
    assert (done.stdout, done.stderr) == ("", "")


def test_waiting_can_be_interrupted(tmp_path, monkeypatch):
    drawer = CurveDrawer()
    drawer.begin()
    process = drawer._process

    class Interrupted:
        def read(self) -> str:
            raise KeyboardInterrupt

        def close(self) -> None:
            pass

    process.stdout.close()
    monkeypatch.setattr(process, "stdout", Interrupted())
    with pytest.raises(KeyboardInterrupt):
        drawer.finish()
    assert process.returncode == -signal.SIGKILL  # it was not waited for


@pytest.mark.parametrize(("cores", "begun"), [(2, 100), (16, 80)])
def test_it_gets_ready_shortly_before_the_end(tmp_path, monkeypatch, cores, begun):
    """Of 100 iterations, ten a second; not where it would take a core from training."""
    import torch

    monkeypatch.setattr(curve_recorder, "cores", lambda: cores)
    said = []
    monkeypatch.setattr(CurveDrawer, "begin", lambda _: said.append("begin"))
    monkeypatch.setattr(CurveDrawer, "draw", lambda _, path, rows, title: said.append((path.name, len(rows), title)))
    views, log = {"test": ["a"], "train": ["b"]}, TrainingLog(tmp_path, 0)
    recorder = CurveRecorder(
        str(tmp_path), [], log, 100, [], views, lambda _: None, lambda _: {"psnr": 20.0}, torch.device("cpu")
    )
    first = None
    for iteration in range(1, 101):
        if recorder.due(iteration, iteration / 10):
            recorder.add(iteration, iteration / 10, 5)
        first = first or (iteration if said else None)
    assert first == begun and said[-1] == (FIGURE, len(recorder.rows), tmp_path.name)
    assert recorder.rows[-1][SUBSET] is None
