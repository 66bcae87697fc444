"""error_vs_time.csv: the error of a model in training against its time, one row per scored iteration."""

import contextlib
import csv
import math
import os
import sys
from collections.abc import Iterable
from pathlib import Path

from splatting.files.plain_files import plain
from utils.system_utils import UserError, atomic_write

NAME = "error_vs_time.csv"
FIGURE = "error_vs_time.png"
SUBSET = "subset"
COUNTS = ("iteration", "gaussians", SUBSET)
SCORES = tuple(f"{views}_{score}" for views in ("test", "train") for score in ("l1", "psnr", "ssim"))
COLUMNS = ("iteration", "seconds", "wall_seconds", "gaussians", "peak_memory_mib", *SCORES, SUBSET)
_HEADERS = (list(COLUMNS), list(COLUMNS[:-1]))  # older files have no subsets

Row = dict[str, float | None]


def read_curve(path: str | os.PathLike) -> list[Row]:
    """Rows of a curve's file in ascending iterations; each has all COLUMNS, None for an empty field.

    seconds: of training, without evaluation and saving, over all resumed parts. wall_seconds: since the start of the
    process, with those of earlier parts. peak_memory_mib: the most of all parts so far, of the GPU if it trains.
    `<views>_l1`, `<views>_psnr` (dB), `<views>_ssim`: gaussian_renderer/scored_views.py. subset: number of views of
    each set that were scored, the same ones in all such rows; None: all. UserError if the file is missing or damaged.
    """
    try:
        with open(plain(path), encoding="utf-8", newline="") as file:
            lines = list(csv.reader(file, strict=True))
        if not lines or lines[0] not in _HEADERS:
            raise ValueError("its columns are different")
        rows = [_row(lines[0], line) for line in lines[1:]]
        iterations = [row["iteration"] for row in rows]
        if iterations != sorted(set(iterations)):
            raise ValueError("its iterations do not ascend")
    except FileNotFoundError as error:
        raise UserError(f"no curve {path}; train.py --eval records one unless --no_curve is set") from error
    except (OSError, ValueError, csv.Error) as error:
        raise UserError(f"{path} cannot be read as a curve ({error}); train again to record one") from error
    return rows


def _row(names: list[str], fields: list[str]) -> Row:
    row: Row = {SUBSET: None}
    for name, field in zip(names, fields, strict=True):
        value = None if field == "" else int(field) if name in COUNTS else float(field)
        if value is None and name in ("iteration", "seconds"):
            raise ValueError(f"a row without {name}")
        if value is not None and not math.isfinite(value):
            raise ValueError(f"a value is {field}")
        row[name] = value
    return row


def write_curve(path: str | os.PathLike, rows: list[Row]) -> None:
    """Write rows that have all COLUMNS. A value that is None or not finite (PSNR of equal images) is left empty."""
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for row in rows:
            values = [row[name] for name in COLUMNS]
            writer.writerow([value if value is not None and math.isfinite(value) else "" for value in values])


def continue_curve(
    model_path: str | os.PathLike, first_iteration: int, before: str | os.PathLike | None = None
) -> list[Row]:
    """Rows of the curve in a model folder up to `first_iteration`, where a run resumes (0: it starts anew).

    Later rows belong to another training and are removed, with the figure. A file without rows is removed. A damaged
    file is removed with a warning, since it is no reason to stop a training. before: the folder of the run that is
    resumed, if it is another one; nothing changes there.
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


def whole_sets(rows: Iterable[Row]) -> list[Row]:
    """The rows that score whole sets. Only these compare with scores of other places, and with each other's best."""
    return [row for row in rows if row.get(SUBSET) is None]


def best_test(rows: Iterable[Row]) -> Row | None:
    """The whole-set row with the highest PSNR of the test views, the first of equals; None if no row has one."""
    scored = [row for row in whole_sets(rows) if row["test_psnr"] is not None]
    return max(scored, key=lambda row: row["test_psnr"], default=None)
