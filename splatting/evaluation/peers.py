"""Curves of other programs, drawn beside ours: CSV files whose columns docs/guide/files.md describes."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from splatting.files.plain_files import plain
from utils.system_utils import UserError, atomic_write

REQUIRED = ("seconds", "test_psnr")
COLUMNS = (
    *("iteration", "seconds", "wall_seconds", "gaussians", "peak_memory_mib"),
    *("test_l1", "test_psnr", "test_ssim", "test_lpips", "train_l1", "train_psnr", "train_ssim"),
)

PeerRow = dict[str, float | None]


def read_peer(path: Path) -> list[PeerRow]:
    """Read a peer's curve: rows in the order of their seconds, with all COLUMNS, None for what is not known.

    The first line names the columns, in any order; only REQUIRED must be there, and other names are ignored. UserError
    for anything else.
    """
    try:
        with open(plain(path), encoding="utf-8", newline="") as file:
            lines = [line for line in csv.reader(file, strict=True) if line]
        header = [name.strip() for name in lines[0]] if lines else []
        if missing := [name for name in REQUIRED if name not in header]:
            raise ValueError(f"it has no column {missing[0]}")
        rows = [_row(dict(zip(header, line, strict=True))) for line in lines[1:]]
        if not rows:
            raise ValueError("it has no points")
    except OSError as error:
        raise UserError(f"cannot read {path} ({error.strerror}); --peer takes a name and a CSV file") from error
    except (ValueError, csv.Error) as error:
        raise UserError(
            f"{path} is not a curve ({error}); its columns must be {' and '.join(REQUIRED)}, others may follow: "
            f"{', '.join(name for name in COLUMNS if name not in REQUIRED)}"
        ) from error
    return sorted(rows, key=lambda row: row["seconds"])


def _row(fields: dict[str, str]) -> PeerRow:
    row: PeerRow = {}
    for name in COLUMNS:
        text = fields.get(name, "").strip()
        value = float(text) if text else None
        if value is None and name in REQUIRED:
            raise ValueError(f"a row without {name}")
        if value is not None and not math.isfinite(value):
            raise ValueError(f"{name} is {text}")
        row[name] = value
    if row["seconds"] <= 0:
        raise ValueError(f"seconds are {row['seconds']:g}, and must be above 0")
    return row


def write_peer(path: Path, rows: Sequence[PeerRow]) -> None:
    """Write a peer's curve with the COLUMNS that any row has."""
    columns = [name for name in COLUMNS if any(row.get(name) is not None for row in rows)]
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        for row in rows:
            writer.writerow(["" if row.get(name) is None else f"{row[name]:.10g}" for name in columns])


def peers_of(given: Sequence[Sequence[str]], scenes: Sequence[str]) -> list[dict[str, Any]]:
    """Read the peers that the command line names, as report.json lists them: scene, name, file, curve.

    given: (name, file) of each --peer. Where there are several scenes, a name is SCENE/NAME. UserError for other names
    and unreadable files.
    """
    peers = []
    for title, file in given:
        scene, slash, name = title.rpartition("/")
        if not slash and len(scenes) == 1:
            scene = scenes[0]
        if scene not in scenes or not name:
            raise UserError(
                f"--peer {title}: name the scene, too, as in --peer {scenes[0]}/{name or 'NAME'} {file}; the scenes "
                f"are {', '.join(scenes)}"
            )
        if any((peer["scene"], peer["name"]) == (scene, name) for peer in peers):
            raise UserError(f"--peer {title} is given twice; give each curve a name of its own")
        peers.append({"scene": scene, "name": name, "file": str(Path(file)), "curve": read_peer(Path(file))})
    return peers
