"""Queries of COLMAP's database, also while COLMAP writes it: progress of features and matches, and matching photos."""

import contextlib
import sqlite3
from collections import Counter
from pathlib import Path

_PAIR = 2147483647  # COLMAP: pair_id = smaller image_id * this + larger image_id


def count_rows(database: Path, table: str) -> int:
    """Count the rows of a table; 0 while it does not exist or is locked."""
    rows = _query(database, f"SELECT COUNT(*) FROM {table}")
    return rows[0][0] if rows else 0


def most_features(database: Path) -> int:
    """Return the largest number of features of a photo."""
    rows = _query(database, "SELECT MAX(rows) FROM keypoints")
    return (rows[0][0] or 0) if rows else 0


def forget_matches(database: Path) -> None:
    """Empty the tables that matching fills; keep the features."""
    if not database.is_file():
        return
    # A database that was interrupted before it had tables has no matches.
    with contextlib.suppress(sqlite3.OperationalError), contextlib.closing(sqlite3.connect(database)) as connection:
        connection.execute("DELETE FROM matches")
        connection.execute("DELETE FROM two_view_geometries")
        connection.commit()


def copy_database(database: Path, target: Path) -> None:
    """Copy a database, including changes that are still in its log."""
    target.unlink(missing_ok=True)
    with contextlib.closing(sqlite3.connect(database)) as source, contextlib.closing(sqlite3.connect(target)) as copy:
        source.backup(copy)


def partners(database: Path) -> dict[str, int]:
    """Count, for every photo, the other photos with which its matches passed the geometric check."""
    names = dict(_query(database, "SELECT image_id, name FROM images"))
    counts = Counter({name: 0 for name in names.values()})
    for (pair,) in _query(database, "SELECT pair_id FROM two_view_geometries WHERE rows > 0"):
        for image in divmod(pair, _PAIR):
            if image in names:
                counts[names[image]] += 1
    return dict(counts)


def _query(database: Path, statement: str) -> list[tuple]:
    if not database.is_file():
        return []
    try:
        connection = sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True, timeout=1)
    except sqlite3.Error:
        return []
    try:
        return connection.execute(statement).fetchall()
    except sqlite3.Error:
        return []
    finally:
        connection.close()
