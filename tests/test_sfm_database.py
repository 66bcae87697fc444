"""COLMAP's database opens while a progress bar reads it."""

import contextlib
import sqlite3
import threading
import time

import pytest

pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")

from splatting.sfm import database  # noqa: E402


def test_a_database_opens_once_its_reader_is_done(tmp_path, monkeypatch):
    path = tmp_path / "database.db"
    pycolmap.Database.open(path).close()
    with contextlib.closing(sqlite3.connect(path)) as other:
        other.execute("PRAGMA journal_mode=DELETE")
    begun = threading.Event()

    def hold() -> None:
        with contextlib.closing(sqlite3.connect(path)) as other:
            other.execute("BEGIN EXCLUSIVE")
            begun.set()
            time.sleep(0.5)

    holder = threading.Thread(target=hold)
    holder.start()
    begun.wait()
    opened = database.opened(path)
    assert opened.num_images() == 0
    opened.close()
    holder.join()
    monkeypatch.setattr(database, "_TRIES", 2)
    path.write_text("no database")
    with pytest.raises(RuntimeError):
        database.opened(path)
