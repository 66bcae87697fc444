"""Windows, simulated: files in use, locks, drives, signals, text without UTF-8, and names of another system."""

import ast
import errno
import fcntl
import os
import selectors
import signal
import socket
import subprocess
import sys
import types
from pathlib import Path
from unittest.mock import DEFAULT, Mock

import pytest
from test_house import ROOMS

from scene.images.find import find_images
from scene.readers.info import exposure_names
from splatting.evaluation import child
from splatting.files import folders, plain_files
from splatting.host import interrupt
from splatting.viewer import server
from utils import system_utils
from utils.system_utils import UserError, atomic_write

ROOT = Path(__file__).resolve().parents[1]


def in_use() -> PermissionError:
    """What Windows raises while another program has a file open."""
    error = PermissionError(errno.EACCES, "being used by another process")
    error.winerror = 32
    return error


def test_a_file_that_another_program_has_open_for_a_moment_is_replaced(tmp_path, monkeypatch):
    target = tmp_path / "model.json"
    target.write_text("old")
    monkeypatch.setattr(os, "replace", Mock(side_effect=[in_use(), in_use(), DEFAULT], wraps=os.replace))
    with atomic_write(target) as path:
        path.write_text("new")
    assert target.read_text() == "new" and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("error", [in_use(), PermissionError(errno.EACCES, "denied")], ids=["in use", "denied"])
def test_a_file_that_stays_open_is_an_error_and_another_error_is_one_at_once(tmp_path, monkeypatch, error):
    replace = Mock(side_effect=error)
    monkeypatch.setattr(system_utils, "_PATIENCE", 0.1)
    monkeypatch.setattr(os, "replace", replace)
    with pytest.raises(UserError, match="cannot write .*model.json"), atomic_write(tmp_path / "model.json") as path:
        path.write_text("new")
    assert (replace.call_count > 1) == hasattr(error, "winerror") and not list(tmp_path.iterdir())


def locking(descriptor: int, mode: int, size: int) -> None:
    """msvcrt.locking: others can neither lock nor read the bytes from the file's position on."""
    assert (mode, size) == (2, 1) and os.lseek(descriptor, 0, os.SEEK_CUR) > 1 << 20
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise PermissionError(errno.EACCES, "Permission denied") from error


def test_a_folder_is_locked(tmp_path, monkeypatch):
    monkeypatch.setattr(folders, "fcntl", None)
    monkeypatch.setattr(folders, "msvcrt", types.SimpleNamespace(locking=locking, LK_NBLCK=2), raising=False)
    monkeypatch.setattr(Path, "unlink", lambda path: (_ for _ in ()).throw(in_use()))  # the file is open
    arguments = (tmp_path, "train.py", "another train.py (process {process})", "-m")
    for _ in range(2):
        with folders.locked(*arguments):
            assert (tmp_path / ".train.lock").read_text() == f"{os.getpid()}\n"
            refused = pytest.raises(UserError, match=rf"another train.py \(process {os.getpid()}\) is at work in")
            with refused, folders.locked(*arguments):
                pass


def test_a_child_gets_ctrl_c_from_the_terminal_alone(monkeypatch):
    """Sending a child SIGINT is an error on Windows."""
    sent = []
    process = types.SimpleNamespace(send_signal=sent.append)
    child._hand_on(KeyboardInterrupt, process)
    assert sent == [signal.SIGINT]
    monkeypatch.setattr(child.os, "name", "nt")
    child._hand_on(KeyboardInterrupt, process)
    monkeypatch.setattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 512, raising=False)
    assert sent == [signal.SIGINT] and interrupt.own_session() == {"creationflags": 512}


def test_a_childs_messages_are_read_without_waiting_for_a_pipe(monkeypatch, capsys):
    """Windows can wait for sockets alone."""
    monkeypatch.setattr(selectors.DefaultSelector, "register", lambda *_: pytest.fail("a pipe was waited for"))
    code = "import sys; print('first', file=sys.stderr); print('x' * 200000, file=sys.stderr); sys.exit(3)"
    done = child.run_child([sys.executable, "-c", code])
    assert done.status == 3 and set(done.lines[-1]) == {"x"}
    assert capsys.readouterr().err == f"first\n{'x' * 200000}\n"


def test_paths_on_two_drives(monkeypatch, tmp_path):
    def no_way(*_: object) -> str:
        raise ValueError("path is on mount 'D:', start on mount 'C:'")

    monkeypatch.setattr(os.path, "relpath", no_way)
    monkeypatch.setattr(os.path, "commonpath", no_way)
    assert plain_files.relative_to(tmp_path / "a.png", tmp_path) == tmp_path / "a.png"
    views = [types.SimpleNamespace(image_name="a", image_path=str(tmp_path / drive / "a.png")) for drive in "CD"]
    assert exposure_names(views) == [(tmp_path / drive / "a.png").as_posix() for drive in "CD"]


def test_photos_that_a_model_of_windows_names(tmp_path):
    """Backslashes, and another letter case."""
    (tmp_path / "left").mkdir()
    (tmp_path / "left/IMG_1.JPG").touch()
    for name in (r"left\IMG_1.JPG", r"LEFT\img_1.jpg"):
        assert find_images(tmp_path, [name], "images.bin", "copy them") == [tmp_path / "left/IMG_1.JPG"]


def test_a_port_that_is_taken_stays_taken(monkeypatch):
    """With SO_REUSEADDR, Windows lets two programs listen at one port."""
    options = []
    monkeypatch.setattr(socket.socket, "setsockopt", lambda *arguments: options.append(arguments))
    monkeypatch.setattr(server.os, "name", "nt")
    assert server._free_port(("127.0.0.1", 0)) == 0 and not options


def test_text_files_are_opened_as_utf_8():
    """Windows would open them in the encoding of its language. Pages of /proc are ASCII, and Linux has them alone."""
    files = [path for room in ROOMS for path in (ROOT / room).rglob("*.py") if room != "benchmarks"]
    unnamed = []
    for path in (*files, *ROOT.glob("*.py")):
        on_linux = {"host", "distributed"} & set(path.relative_to(ROOT).parts)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and _is_text(node) and not on_linux:
                unnamed.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert unnamed == []


def _is_text(call: ast.Call) -> bool:
    """Whether a call opens a file as text and names no encoding."""
    words = {word.arg: word.value for word in call.keywords}
    if {"encoding", None} & words.keys():
        return False
    if isinstance(call.func, ast.Attribute):
        return call.func.attr in ("read_text", "write_text")
    if not isinstance(call.func, ast.Name) or call.func.id != "open":
        return False
    modes = [*call.args[1:2], words.get("mode")]
    return not any(isinstance(mode, ast.Constant) and "b" in mode.value for mode in modes)
