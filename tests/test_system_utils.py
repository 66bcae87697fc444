"""Files, exit statuses, and the choice of the device."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from utils import system_utils
from utils.system_utils import UserError, atomic_write, run_cli, saved_iterations, searchForMaxIteration

ROOT = Path(__file__).resolve().parents[1]


def _raise(error: BaseException) -> None:
    raise error


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (UserError("fix it like this"), 2, "error: fix it like this\n"),
        (
            OSError(errno.EROFS, "Read-only file system", "m/times.json"),
            2,
            "error: the system refuses m/times.json (Read-only file system); fix its permissions, free space there, or "
            "choose another place\n",
        ),
        (KeyboardInterrupt("stopped from the page"), 130, "stopped from the page\n"),
    ],
)
def test_run_cli_says_one_line_and_exits(error, status, said, capsys):
    with pytest.raises(SystemExit) as exit_info:
        run_cli(lambda: _raise(error))
    assert exit_info.value.code == status and capsys.readouterr() == ("", said)
    with pytest.raises(ZeroDivisionError):  # a bug keeps its traceback
        run_cli(lambda: 1 / 0)
    with pytest.raises(FileNotFoundError):
        run_cli(lambda: _raise(FileNotFoundError(errno.ENOENT, "No such file", "a.txt")))


@pytest.mark.parametrize(
    ("capability", "said"),
    [
        ((7, 0), "capability 7.0, but 7.5 is the oldest that works: set CUDA_VISIBLE_DEVICES= to use the CPU\n"),
        ((8, 6), "capability 8.6, for which torch or this build has no code: run `pip install --force-reinstall .`\n"),
    ],
)
def test_a_gpu_without_code(capability, said, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "The GPU")
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: capability)
    with pytest.raises(SystemExit) as exit_info:
        run_cli(lambda: _raise(RuntimeError("project: no kernel image is available for execution on the device")))
    assert exit_info.value.code == 2 and capsys.readouterr().err == f"error: The GPU has compute {said}"


@pytest.mark.parametrize(
    ("sent", "status", "said"),
    [
        (["SIGINT"], 130, "interrupted\n"),
        (["SIGTERM", "SIGTERM"], 143, "terminated\n"),
        (["SIGHUP", "SIGHUP", "SIGTERM"], 143, "terminated\n"),  # as a terminal, its shell and a user may do
    ],
)
def test_signals_leave_no_half_written_file(tmp_path, sent, status, said):
    script = (
        "import os, signal, sys\n"
        "from utils.system_utils import atomic_write, run_cli\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # a background job's child inherits it ignored
        "def main():\n"
        "    with atomic_write(sys.argv[1]) as path:\n"
        "        path.write_text('half')\n"
        "        try:\n"
        "            os.kill(os.getpid(), getattr(signal, sys.argv[2]))\n"
        "        finally:\n"
        "            [os.kill(os.getpid(), getattr(signal, name)) for name in sys.argv[3:]]\n"
        "run_cli(main)\n"
    )
    command = [sys.executable, "-c", script, str(tmp_path / "file"), *sent]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (status, said) and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("line", ["print('a')", "print('a', flush=True)", "print('a', flush=True, file=sys.stderr)"])
def test_a_reader_that_went_away_is_no_traceback(line):
    script = (
        "import sys\nfrom utils.system_utils import run_cli\nsys.stdin.read()\n"
        f"def main():\n    {line}\nrun_cli(main)\n"
    )
    broken = "stderr" if "stderr" in line else "stdout"
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    with subprocess.Popen([sys.executable, "-c", script], cwd=ROOT, **pipes) as run:
        getattr(run, broken).close()
        run.stdin.close()
        said = (run.stdout if broken == "stderr" else run.stderr).read()
        assert (run.wait(60), said) == (141, b"")


def test_a_refused_write_names_the_target_and_leaves_nothing(tmp_path):
    (tmp_path / "results.json").mkdir()
    refused = pytest.raises(UserError, match=r"cannot write .*results.json \(Is a directory\); free space")
    with refused, atomic_write(tmp_path / "results.json") as path:
        path.write_text("{}")
    with pytest.raises(UserError, match="cannot write .*new.json .No space left"), atomic_write(tmp_path / "new.json"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert [path.name for path in tmp_path.iterdir()] == ["results.json"]


def test_atomic_write_replaces_only_when_the_block_ends_well(tmp_path):
    target = tmp_path / "new" / "picture.png"
    with atomic_write(target) as path:
        assert path.parent == target.parent and path.suffix == ".png"
        path.write_text("whole")
        assert not target.exists()
    assert target.read_text() == "whole"
    with pytest.raises(RuntimeError), atomic_write(target) as path:
        path.write_text("half")
        raise RuntimeError
    assert target.read_text() == "whole"
    assert list(target.parent.iterdir()) == [target]


def test_iterations_are_compared_as_numbers(tmp_path):
    for name in ("iteration_7000", "iteration_30000", "iteration_900", "iteration_x", "other_99999"):
        (tmp_path / name).mkdir()
    assert saved_iterations(tmp_path) == [900, 7000, 30000]
    assert searchForMaxIteration(tmp_path) == 30000
    with pytest.raises(UserError, match="no saved iteration"):
        searchForMaxIteration(tmp_path / "missing")


def test_compute_device_needs_a_gpu_and_its_kernels(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    for kernels in (False, True):
        monkeypatch.setattr("diff_gaussian_rasterization.has_cuda_kernels", lambda has=kernels: has)
        assert system_utils.compute_device().type == ("cuda" if kernels else "cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert system_utils.compute_device().type == "cpu"
