"""Curves, error against time: error_vs_time.csv of a training, and the CSV files of other programs (`--peer`).

A training may score a subset of each set of views at most points, to save time. A subset is named by its number of
views, and None stands for whole sets.
"""

import contextlib
import csv
import math
import os
import sys
from collections import Counter
from collections.abc import Container, Iterable, Sequence
from pathlib import Path
from typing import Any

from groundwork.files.plain_files import encoding_of
from utils.system_utils import UserError, atomic_write

NAME = "error_vs_time.csv"
FIGURE = "error_vs_time.png"
SUBSET = "subset"
COUNTS = ("iteration", "gaussians", SUBSET)
SCORES = tuple(f"{views}_{score}" for views in ("test", "train") for score in ("l1", "psnr", "ssim"))
COSTS = ("iteration", "seconds", "wall_seconds", "gaussians", "peak_memory_mib")
_OLDEST = (*COSTS, *SCORES)
COLUMNS = (*_OLDEST, SUBSET)
_ESTIMATED = "estimated"  # a column of older files: rows that tell of whole sets what only a part of them says
PEER_COLUMNS = (*COSTS, *SCORES[:3], "test_lpips", *SCORES[3:])
PEER_REQUIRED = ("seconds", "test_psnr")
FITTED = 18.0  # dB of training views; below, nothing is called overfitting
CLEAR = 0.1  # dB between two points; those of a settled training differed by up to 0.07

Row = dict[str, float | None]


def read_curve(path: str | os.PathLike) -> list[Row]:
    """Read the rows of a training's curve, in ascending iterations; each has all COLUMNS, None for an empty field.

    An iteration has a row for each part of the test views that was scored there. Estimates in older files are left out.
    UserError if the file is missing or damaged. Columns:

    seconds: seconds of training, without evaluation and saving, over all resumed parts.
    wall_seconds: seconds since the start of the process, with those of earlier parts.
    peak_memory_mib: the most memory of all parts so far, of the GPU if it trains.
    `<views>_l1`, `<views>_psnr` (dB), `<views>_ssim`: scores, as in gaussian_renderer/scored_views.py.
    subset: number of views of each set that were scored, the same views in all rows of that number; None: all.
    """
    try:
        header, *lines = _read_lines(path)
        if header[: len(_OLDEST)] != list(_OLDEST):
            raise ValueError("its columns are different")
        measured = _drop_lines(_ESTIMATED, header, lines)
        rows = [_parse_row(header, line, COLUMNS, ("iteration", "seconds"), COUNTS) for line in measured]
        places = [(row["iteration"], math.inf if row[SUBSET] is None else row[SUBSET]) for row in rows]
        if places != sorted(set(places)):
            raise ValueError("its iterations do not ascend")
    except FileNotFoundError as error:
        raise UserError(f"no curve {path}; train.py --eval records one") from error
    except (OSError, ValueError, csv.Error) as error:
        raise UserError(f"{path} cannot be read as a curve ({error}); train again to record one") from error
    return rows


def _read_lines(path: str | os.PathLike) -> list[list[str]]:
    """Return the lines of a CSV file as lists of stripped fields, the header first."""
    with open(path, encoding=encoding_of(path), newline="") as file:
        return [[field.strip() for field in line] for line in csv.reader(file, strict=True) if line] or [[]]


def _drop_lines(name: str, header: Sequence[str], lines: Iterable[Sequence[str]]) -> list[Sequence[str]]:
    """Return the lines whose field in the column `name` is empty."""
    return [line for line in lines if not dict(zip(header, line, strict=True)).get(name)]


def _parse_row(
    header: Sequence[str], line: Sequence[str], columns: Sequence[str], required: Sequence[str], counts: Sequence[str]
) -> Row:
    """Return a line's values of `columns`, None for empty fields.

    ValueError for an empty field that is required.

    counts: columns of whole numbers.
    """
    fields, row = dict(zip(header, line, strict=True)), {}
    for name in columns:
        text = fields.get(name, "")
        row[name] = None if not text else int(text) if name in counts else float(text)
        if row[name] is None and name in required:
            raise ValueError(f"a row without {name}")
        if not math.isfinite(row[name] or 0):
            raise ValueError(f"{name} is {text}")
    return row


def _write_lines(path: str | os.PathLike, columns: Sequence[str], lines: Iterable[Sequence[Any]]) -> None:
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([columns, *lines])


def write_curve(path: str | os.PathLike, rows: list[Row]) -> None:
    """Write rows that have all COLUMNS. A value that is None or not finite (PSNR of equal images) is left empty."""
    values = ((row[name] for name in COLUMNS) for row in rows)
    _write_lines(path, COLUMNS, [["" if x is None or not math.isfinite(x) else x for x in line] for line in values])


def continue_curve(
    model_path: str | os.PathLike, first_iteration: int, before: str | os.PathLike | None = None
) -> list[Row]:
    """Return the rows of the curve in a model folder up to `first_iteration`, where a run resumes (0: a new run).

    Later rows belong to another training and are removed, with the figure. A file without rows is removed. A damaged
    file is removed with a warning, since it is no reason to stop a training.

    before: folder of the run that is resumed, if it is another one; nothing changes there.
    """
    path = Path(model_path) / NAME
    source = path if before is None else Path(before) / NAME
    rows = []
    with contextlib.suppress(OSError, UserError):  # if a file cannot be removed, writing it later will warn
        (path.parent / FIGURE).unlink(missing_ok=True)
        if first_iteration and source.exists():
            try:
                rows = [row for row in read_curve(source) if row["iteration"] <= first_iteration]
            except UserError as error:
                print(f"warning: {error}; a new curve is started", file=sys.stderr)
        if rows:
            write_curve(path, rows)
        else:
            path.unlink(missing_ok=True)
    return rows


def rows_on(rows: Iterable[Row], subset: float | None) -> list[Row]:
    """Return the rows that score a subset of the views. Only rows on the same views compare.

    subset: its number of views; None: whole sets.
    """
    return [row for row in rows if row.get(SUBSET) == subset]


def whole_sets(rows: Iterable[Row]) -> list[Row]:
    """Return the rows that score whole sets. Only these rows compare with scores from elsewhere."""
    return rows_on(rows, None)


def common_subset(curves: Iterable[Iterable[Row]]) -> int | None:
    """Return the subset of the test views on which curves compare: its number of views; None: all test views.

    It is a subset that every curve has scored. Among several, the one whose shortest curve has the most points; among
    equals, all test views. Curves without test PSNR do not take part. None, too, if no subset is common to all curves.
    """
    found = [Counter(row.get(SUBSET) for row in curve if row["test_psnr"] is not None) for curve in curves]
    counts = [count for count in found if count]
    shared = set.intersection(*map(set, counts)) if counts else set()
    return max(shared, key=lambda subset: (min(count[subset] for count in counts), subset is None), default=None)


def best_test(rows: Iterable[Row]) -> Row | None:
    """Return the whole-set row with the highest PSNR of the test views, the first of equals; None if no row has one."""
    scored = [row for row in whole_sets(rows) if row["test_psnr"] is not None]
    return max(scored, key=lambda row: row["test_psnr"], default=None)


def gain_since_peak(rows: Sequence[Row]) -> float | None:
    """Return the PSNR that training views gained while test views lost (`peak`); None if either is not CLEAR."""
    found, end = peak(rows), whole_sets(rows)
    # What does not fit the training views cannot overfit.
    if found is None or found[0]["train_psnr"] is None or (end[-1]["train_psnr"] or 0.0) < FITTED:
        return None
    gained = end[-1]["train_psnr"] - found[0]["train_psnr"]
    return None if gained < CLEAR else gained


def peak(rows: Sequence[Row]) -> tuple[Row, float] | None:
    """Return the whole-set row with the best test views, and the PSNR lost since; None if the loss is not CLEAR."""
    rows = whole_sets(rows)
    best = best_test(rows)
    if best is None or rows[-1]["test_psnr"] is None:
        return None
    lost = best["test_psnr"] - rows[-1]["test_psnr"]
    return None if lost < CLEAR else (best, lost)


def peak_advice(rows: Sequence[Row], saved: Container[int], steady: bool = True) -> str | None:
    """Return a line that names the iteration with the best test views; None unless the last row was clearly worse.

    saved: iterations whose PLY this training has written. Each was written before the iteration's step, so it is the
        model that was scored.
    steady: true if another training has the same iterations; one by the clock has not.
    """
    if (found := peak(rows)) is None:
        return None
    best, lost = found
    at = best["iteration"]
    line = f"Best test PSNR {best['test_psnr']:.2f} dB at iteration {at} ({lost:.2f} above the end)"
    if at in saved:
        return f"{line}. It is saved: render.py --iteration {at}"
    return f"{line}. Keep it: --save_iterations {at}" if steady else line


def read_peer(path: Path, required: Sequence[str] = PEER_REQUIRED) -> list[Row]:
    """Read another program's curve: rows in the order of their seconds, with all PEER_COLUMNS, None if not known.

    The first line names the columns, in any order. Only the required columns, seconds among them, must be there, and
    other names are ignored. UserError for anything else.
    """
    try:
        header, *lines = _read_lines(path)
        if missing := [name for name in required if name not in header]:
            raise ValueError(f"it has no column {missing[0]}")
        whole = _drop_lines(SUBSET, header, lines)  # of a training's curve
        rows = [_parse_row(header, line, PEER_COLUMNS, required, ()) for line in whole]
        if not rows:
            raise ValueError("it has no points")
        if (least := min(row["seconds"] for row in rows)) <= 0:
            raise ValueError(f"seconds are {least:g}, and must be above 0")
    except OSError as error:
        raise UserError(f"cannot read {path} ({error.strerror}); give a CSV file of a curve") from error
    except (ValueError, csv.Error) as error:
        raise UserError(
            f"{path} is not a curve ({error}); its columns must be {' and '.join(required)}, others may follow: "
            f"{', '.join(name for name in PEER_COLUMNS if name not in required)}"
        ) from error
    return sorted(rows, key=lambda row: row["seconds"])


def write_peer(path: Path, rows: Sequence[Row]) -> None:
    """Write another program's curve with the PEER_COLUMNS that any row has."""
    columns = [name for name in PEER_COLUMNS if any(row.get(name) is not None for row in rows)]
    values = ((row.get(name) for name in columns) for row in rows)
    _write_lines(path, columns, [["" if x is None else f"{x:.10g}" for x in line] for line in values])


def peers_of(given: Sequence[Sequence[str]], scenes: Sequence[str]) -> list[dict[str, Any]]:
    """Read the peers that the command line names, as report.json lists them: scene, name, file, curve.

    UserError for other names and unreadable files.

    given: (name, file) of each --peer. A name is SCENE/NAME where there are several scenes.
    scenes: names of the scenes.
    """
    peers: dict[tuple[str, str], dict[str, Any]] = {}
    for title, file in given:
        scene, slash, name = title.rpartition("/")
        if not slash and len(scenes) == 1:
            scene = scenes[0]
        if scene not in scenes or not name:
            raise UserError(
                f"--peer {title}: name the scene, too, as in --peer {scenes[0]}/{name or 'NAME'} {file}; the scenes "
                f"are {', '.join(scenes)}"
            )
        if (scene, name) in peers:
            raise UserError(f"--peer {title} is given twice; give each curve a name of its own")
        peers[scene, name] = {"scene": scene, "name": name, "file": str(Path(file)), "curve": read_peer(Path(file))}
    return list(peers.values())
