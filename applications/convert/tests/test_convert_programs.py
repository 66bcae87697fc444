"""Stages of convert.py, and programs that it runs: their options, their ends, and its own end while they work."""

import os
import signal
import stat
import subprocess
import sys
import threading
from dataclasses import replace
from functools import partial
from pathlib import Path

import pycolmap
import pytest
from waiting import LIMIT, wait_for

from applications.convert import colmap, programs
from applications.convert.colmap import LENS_MODELS, Program, Settings
from applications.convert.layout import Layout
from applications.convert.programs import refuse_while_working, run_programs
from applications.convert.stages import Stage, StageRecord
from utils.system_utils import UserError

ROOT = Path(__file__).resolve().parents[3]
SETTINGS = Settings("OPENCV", 8192, "exhaustive", "incremental", no_gpu=True)


@pytest.mark.parametrize("is_for_group", [False, True])
def test_ctrl_c_ends_the_program_that_works(tmp_path, is_for_group):
    """Also where the program gets the signal, too, and ends by itself."""
    log, script = tmp_path / "log", "import os, time; print(os.getpid(), flush=True); time.sleep(600)"

    def interrupt() -> None:
        try:
            wait_for(lambda: log.is_file() and log.read_text().endswith("\n"))
        finally:
            if is_for_group:
                os.kill(int(log.read_text()), signal.SIGTERM)
            os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyboardInterrupt):
        run_programs(log, [[sys.executable, "-c", script]], "Waiting", 1, lambda: 0)
    with pytest.raises(ProcessLookupError):
        os.kill(int(log.read_text()), 0)


def _killed_while(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str, *words: str) -> Path:
    """Call run_programs with a script in a process that is killed once the script has written to the log; the log."""
    code = "import sys; from pathlib import Path; from applications.convert.programs import run_programs; "
    code += "run_programs(Path(sys.argv[1]), [sys.argv[2:]], 'Waiting', 1, lambda: 0)"
    log, python = tmp_path / "log", [sys.executable, "-c"]
    command = [*python, code, str(log), *python, script, *words]
    caller = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL)
    wait_for(lambda: log.is_file() and log.read_text().endswith("\n"))
    monkeypatch.setattr(programs, "_ORPHAN_PATIENCE", 0.0)
    with pytest.raises(UserError, match="another convert.py, or a program that a killed one had started, still works"):
        refuse_while_working(log)
    caller.kill()
    caller.wait()
    return log


def test_a_killed_caller_leaves_no_worker(tmp_path, monkeypatch):
    (tmp_path / "job.json").write_text('{"step": "wait"}')
    script = (
        "import sys, time; sys.path.insert(0, 'applications/convert'); import worker; "
        "worker.STEPS['wait'] = lambda job: (print('at work', flush=True), time.sleep(600)); "
        "worker.main(sys.argv[1])"
    )
    log = _killed_while(tmp_path, monkeypatch, script, str(tmp_path / "job.json"))
    # The lock tells whether the worker ended. Its process id does not, as there may be no process to reap it.
    monkeypatch.setattr(programs, "_ORPHAN_PATIENCE", LIMIT)
    refuse_while_working(log)


def test_programs_that_outlive_a_killed_caller_are_waited_for(tmp_path, monkeypatch):
    script = "import os, time; print(os.getpid(), flush=True); time.sleep(600)"
    log = _killed_while(tmp_path, monkeypatch, script)
    try:
        with pytest.raises(UserError, match="still works in .*; wait for it or end it"):
            run_programs(log, [["true"]], "Next", 1, lambda: 0)
    finally:
        os.kill(int(log.read_text()), signal.SIGKILL)
    monkeypatch.setattr(programs, "_ORPHAN_PATIENCE", LIMIT)
    refuse_while_working(log)


def test_a_program_that_fails_is_quoted(tmp_path):
    script = "import sys; print('first'); print('no disk left'); sys.exit(3)"
    with pytest.raises(UserError, match=r"features failed \(status 3: no disk left\); all output is in .*log"):
        run_programs(tmp_path / "log", [[sys.executable, "-c", script]], "Features", 1, lambda: 0)
    with pytest.raises(UserError, match="cannot run /no/program"):
        run_programs(tmp_path / "log", [["/no/program"]], "Features", 1, lambda: 0)


def _fake_colmap(folder: Path, prefix: str, without: str = "") -> str:
    """A program that answers like COLMAP; its GPU options are <prefix>Extraction.use_gpu, <prefix>Matching.use_gpu."""
    path = folder / "colmap"
    path.write_text(
        f'#!/bin/sh\ncase "$1" in\n{without or "none"}) exit 1;;\nhelp) echo "COLMAP 9.9";;\n'
        f"feature_extractor) echo '  --{prefix}Extraction.use_gpu arg (=1)';;\n"
        f"*_matcher) echo '  --{prefix}Matching.use_gpu arg (=1)';;\nesac\n"
    )
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


@pytest.mark.parametrize("prefix", ["Sift", "Feature"])
def test_options_are_those_of_the_colmap_that_is_there(tmp_path, prefix):
    layout = Layout(tmp_path / "scene")
    program = Program(_fake_colmap(tmp_path, prefix), layout, SETTINGS)
    (first, second) = program.features([["a b.png"], ["c.png", "d.png"]], masks=True)
    assert first[-2:] == second[-2:] == [f"--{prefix}Extraction.use_gpu", "0"]
    assert Path(second[second.index("--image_list_path") + 1]).read_text() == "c.png\nd.png\n"
    assert first[first.index("--ImageReader.mask_path") + 1] == str(layout.masks)
    (each,) = program.features([["a b.png"], ["c.png"]], masks=False)
    assert "--ImageReader.single_camera_per_image" in each and "--ImageReader.single_camera" not in each
    ((_, *match),) = program.matching()
    database = ["--database_path", str(layout.database)]
    assert match == ["exhaustive_matcher", *database, f"--{prefix}Matching.use_gpu", "0"]
    (mapper,) = program.mapping("incremental", layout.models)
    assert mapper[1] == "mapper" and mapper[-2:] == ["--Mapper.ba_global_function_tolerance", "1e-06"]


def test_programs_that_can_not_do_it(tmp_path):
    layout, whole = Layout(tmp_path / "scene"), replace(SETTINGS, mapper="global")
    with pytest.raises(UserError, match="help` as COLMAP does"):
        Program("/bin/true", layout, SETTINGS)
    with pytest.raises(UserError, match="lists neither --FeatureExtraction.use_gpu nor --SiftExtraction.use_gpu"):
        Program(_fake_colmap(tmp_path, "New"), layout, SETTINGS)
    program = Program(_fake_colmap(tmp_path, "Sift"), layout, whole)
    ((calibrate,), (mapper,)) = program.calibration(), program.mapping("global", layout.models)
    assert [calibrate[1], mapper[1]] == ["view_graph_calibrator", "global_mapper"]
    assert calibrate[3] == mapper[3] == str(layout.calibrated)
    old = _fake_colmap(tmp_path, "Sift", without="global_mapper")
    assert Program(old, layout, replace(SETTINGS, mapper="auto")).ways == ("incremental",)
    with pytest.raises(UserError, match="COLMAP 9.9.*has no global_mapper; use --mapper incremental"):
        Program(old, layout, whole)


def test_every_lens_model_can_be_asked_for():
    assert {*LENS_MODELS, "INVALID"} == set(pycolmap.CameraModelId.__members__)


def test_which_photos_stay_as_they_are():
    stay = {model.removesuffix("_FISHEYE") for model in LENS_MODELS if colmap.is_native("auto", {"OPENCV", model})}
    assert stay == {"EQUIRECTANGULAR", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "THIN_PRISM"}
    assert colmap.is_native("native", {"OPENCV"}) and not colmap.is_native("undistort", {"OPENCV_FISHEYE"})


def test_stages_are_redone_from_the_first_that_changed(tmp_path):
    def run(fail: str = "", **made_from: int) -> list[str]:
        done: list[str] = []

        def work(name: str) -> None:
            done.append(name)
            if name == fail:
                raise KeyboardInterrupt

        stages = [
            Stage(name, value, partial(done.append, f"-{name}"), partial(work, name), resumable=name == "b")
            for name, value in made_from.items()
        ]
        try:
            kept = StageRecord(tmp_path / "stages.json").run(stages)
            return [*(f"={name}" for name in kept), *done]
        except KeyboardInterrupt:
            return [*done, "stopped"]

    assert run(a=1, b=1, c=1) == ["-c", "-b", "-a", "a", "-c", "-b", "b", "-c", "c"]
    assert run(a=1, b=1, c=1) == ["=a", "=b", "=c"]
    assert run(a=1, b=2, c=1, fail="b") == ["-c", "-b", "b", "stopped"]
    # b is resumable, so it is not reset; c was never begun.
    assert run(a=1, b=2, c=1, fail="c") == ["-c", "b", "-c", "c", "stopped"]
    assert run(a=1, b=2, c=1) == ["=a", "=b", "-c", "c"]
    assert run(a=2, b=2, c=1)[:4] == ["-c", "-b", "-a", "a"]
    (tmp_path / "stages.json").write_text("[]")
    with pytest.raises(UserError, match="stages.json is damaged; remove the folder"):
        run(a=1)
