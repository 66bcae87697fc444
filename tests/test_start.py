"""Start and end of a command: Ctrl-C while modules are imported, and outputs that are closed or full."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from waiting import LIMIT, wait_for

from groundwork.host.start import typed_command

ROOT = Path(__file__).parents[1]
COMMANDS = ("train", "render", "metrics")
if (ROOT / "applications").is_dir():
    COMMANDS += ("full_eval", "convert", "doctor")
needs_full = pytest.mark.skipif(not os.path.exists("/dev/full"), reason="the system has no /dev/full")


def _heed_ctrl_c() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # a shell's background ignores it


@pytest.mark.parametrize("command", COMMANDS)
def test_ctrl_c_while_modules_are_imported_is_no_traceback(tmp_path, command):
    """A package that every command imports early waits, as a slow disk would, and then swallows what is raised."""
    (tmp_path / "numpy.py").write_text(
        "import pathlib, time\n"
        "try:\n"
        f"    pathlib.Path({str(tmp_path / 'there')!r}).touch()\n"
        "    time.sleep(600)\n"
        "except BaseException:\n"
        "    pass\n"
        "raise ImportError\n"
    )
    (tmp_path / "torch.py").write_text((tmp_path / "numpy.py").read_text())
    words = {"convert": ["-s", "nowhere"], "doctor": []}.get(command, ["-m", "nowhere"])
    process = subprocess.Popen(
        [sys.executable, f"{command}.py", *words], cwd=ROOT, env=os.environ | {"PYTHONPATH": str(tmp_path)},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, preexec_fn=_heed_ctrl_c,
    )  # fmt: skip
    try:
        wait_for((tmp_path / "there").exists)
        process.send_signal(signal.SIGINT)
        assert process.communicate(timeout=LIMIT) == (b"", b"")
    finally:
        process.kill()
    assert process.returncode == -signal.SIGINT


def _run(script: str, redirection: str, tmp_path: Path) -> subprocess.CompletedProcess:
    program = tmp_path / "program.py"
    program.write_text(
        f"import sys\nfrom utils.system_utils import run_cli\ndef main():\n    {script}\nrun_cli(main)\n"
    )
    command = f'"{sys.executable}" "{program}" {redirection}'
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONIOENCODING": "utf-8:strict"}
    words = ["sh", "-c", command]
    return subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=2 * LIMIT)


@needs_full
@pytest.mark.parametrize("script", ["print('a')", "print('a', flush=True)", "print('a' * 100_000)"])
def test_a_full_output_is_one_sentence(tmp_path, script):
    done = _run(script, ">/dev/full", tmp_path)
    assert done.returncode == 2
    assert done.stderr == (
        "error: cannot write to the standard output (No space left on device); free space there, or send the output "
        "elsewhere\n"
    )
    assert _run(script, ">/dev/full 2>/dev/full", tmp_path).returncode == 2


@pytest.mark.parametrize("redirection", [">&-", "2>&-", ">&- 2>&-"])
def test_a_closed_output_does_not_matter(tmp_path, redirection):
    done = _run(f"print('a', flush=True); sys.stderr.write('b'); open({str(tmp_path / 'done')!r}, 'w')", redirection,
                tmp_path)  # fmt: skip
    assert done.returncode == 0 and (tmp_path / "done").exists()
    assert "Traceback" not in done.stderr


def test_train_with_a_closed_output_trains(tmp_path, colmap_scene):
    words = f'"{sys.executable}" train.py -s "{colmap_scene}" -m "{tmp_path / "model"}" --iterations 3 >&- 2>&-'
    assert subprocess.run(["sh", "-c", words], cwd=ROOT, timeout=120).returncode == 0
    assert (tmp_path / "model" / "point_cloud" / "iteration_3" / "point_cloud.ply").exists()


def test_a_python_without_torch_is_named():
    done = subprocess.run([sys.executable, "-S", "train.py", "-s", "x"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == (
        f"error: {sys.executable} has no torch; run make install, then .venv/bin/python train.py -s x\n"
    )


def test_the_command_that_a_person_types(monkeypatch, tmp_path):
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "bin x" / "python"))
    assert typed_command("view.py") == f"'{tmp_path}/bin x/python' view.py"
    assert typed_command("-m scene.export_world") == f"'{tmp_path}/bin x/python' -m scene.export_world"
    monkeypatch.chdir(tmp_path)
    assert typed_command("view.py") == f"'bin x/python' {ROOT}/view.py"
    monkeypatch.setattr("shutil.which", lambda *_, **__: sys.executable)
    assert typed_command("view.py") == f"python {ROOT}/view.py"
    monkeypatch.chdir("/")
    assert typed_command("view.py") == f"python {ROOT}/view.py"
    assert typed_command("-m scene.export_world") == f"PYTHONPATH={ROOT} python -m scene.export_world"
