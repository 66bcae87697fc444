"""COLMAP's database opens while a progress bar of another process reads it."""

import contextlib
import sqlite3
import subprocess
import sys
from types import SimpleNamespace

import pytest

pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")

from applications.convert import database  # noqa: E402

READER = """
import sqlite3, sys
connection = sqlite3.connect(sys.argv[1], isolation_level=None)
connection.execute("BEGIN")
print(connection.execute("SELECT COUNT(*) FROM images").fetchall(), flush=True)
sys.stdin.read()
"""


def test_a_database_opens_once_its_reader_is_done(tmp_path, monkeypatch):
    path = tmp_path / "database.db"
    pycolmap.Database.open(path).close()
    with contextlib.closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA journal_mode=DELETE")  # as of a new one
    process = subprocess.Popen([sys.executable, "-c", READER, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout.readline()
    with pytest.raises(RuntimeError):
        pycolmap.Database.open(path)
    pauses = []
    # Not `time.sleep` itself, which threads of other modules call.
    clock = SimpleNamespace(sleep=lambda seconds: pauses.append(seconds) or process.communicate())
    monkeypatch.setattr(database, "time", clock)
    opened = database.opened(path)
    assert opened.num_images() == 0 and len(pauses) == 1
    opened.close()
    path.write_text("no database")
    with pytest.raises(RuntimeError):
        database.opened(path)
