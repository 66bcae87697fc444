"""A CSV file for `full_eval.py --peer`, made from the output of another program.

python -m applications.evaluation.peer_curve gsplat RESULT_DIR FILE.csv       result folder of simple_trainer.py
python -m applications.evaluation.peer_curve reference MODEL_OR_LOG FILE.csv  model folder with TensorBoard's files, or
                                                                 saved output, of the reference's train.py

Says what the seconds contain.
"""

from __future__ import annotations

import json
import re
import statistics
from argparse import ArgumentParser
from bisect import bisect_right
from collections.abc import Sequence
from datetime import datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from groundwork.files.plain_files import plain_text
from splatting.records.error_curve import Row, write_peer
from utils.system_utils import UserError, run_cli

if TYPE_CHECKING:
    from tensorboard.backend.event_processing.event_accumulator import ScalarEvent

WITH_PAUSES = (
    "seconds run on the clock from the first iteration; from the second point on they contain the scoring and saving "
    "of earlier points"
)
WITHOUT_PAUSES = "seconds are of training, without scoring and saving at scored iterations"
NEAR = 20  # gaps between logged iterations, on each side, whose median replaces a gap with a pause
_STAMP = re.compile(r" \[(\d\d)/(\d\d) (\d\d):(\d\d):(\d\d)\]\s*$")
_TESTED = re.compile(r"\[ITER (\d+)\] Evaluating (test|train): L1 ([\d.eE+-]+) PSNR ([\d.eE+-]+)")
_LATER = re.compile(r"\[ITER |%\|")  # lines of training itself: what it saves, and its progress bar
_SCORED = "test/loss_viewpoint - psnr"
_COLUMNS = {
    "test/loss_viewpoint - l1_loss": "test_l1",
    _SCORED: "test_psnr",
    "train/loss_viewpoint - l1_loss": "train_l1",
    "train/loss_viewpoint - psnr": "train_psnr",
    "total_points": "gaussians",
}


def from_gsplat(folder: Path) -> list[Row]:
    """Read stats/val_stepN.json (scores) and stats/train_stepN_rank0.json (seconds, memory, Gaussians) of a result.

    Steps count from 0 there. `ellipse_time` is the seconds since the first step in the second file; in the first one
    it is those of rendering a view, which are not used. A scored step without a file of the second kind has no
    seconds: it is left out. UserError if there are no points.
    """
    stats = folder / "stats" if (folder / "stats").is_dir() else folder
    rows = []
    for path in stats.glob("val_step*.json"):
        saved = stats / f"{path.stem.replace('val', 'train', 1)}_rank0.json"
        if not saved.is_file():
            continue
        scores, costs = _read_stats(path), _read_stats(saved)
        try:
            row = {"iteration": int(path.stem.removeprefix("val_step")) + 1, "seconds": float(costs["ellipse_time"])}
            row |= {"gaussians": int(costs["num_GS"]), "peak_memory_mib": 1024 * float(costs["mem"])}
            rows.append(row | {f"test_{name}": float(scores[name]) for name in ("psnr", "ssim", "lpips")})
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(f"{path} or {saved.name} lacks a number ({error}); train again") from error
    if not rows:
        raise UserError(
            f"{stats} has no val_stepN.json with a train_stepN_rank0.json beside it; give the result folder of a "
            "training whose --save_steps are its --eval_steps"
        )
    return sorted(rows, key=lambda row: row["iteration"])


def _read_stats(path: Path) -> dict[str, Any]:
    try:
        return json.loads(plain_text(path))
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read ({error}); train again") from error


def from_log(path: Path) -> list[Row]:
    """Read a saved console output of the reference's train.py, whose lines end with the time, to a second.

    Training begins after the last line before the first score. UserError if there are no scores.
    """
    try:
        lines = plain_text(path, errors="replace").splitlines()
    except OSError as error:
        raise UserError(f"cannot read {path} ({error.strerror}); give a saved console output") from error
    rows: dict[int, Row] = {}
    begin = now = None
    for line in lines:
        stamp = _STAMP.search(line)
        try:
            now = _parse_later(now, stamp) if stamp else now
        except ValueError as error:
            raise UserError(
                f"{path} has a line whose time does not exist: {stamp[0].strip()}; save it again"
            ) from error
        tested = _TESTED.search(line)
        if tested is None:
            if not rows and now and _STAMP.sub("", line).strip() and not _LATER.search(line):
                begin = now
            continue
        if begin is None or not stamp:
            raise UserError(f"{path} has no times at the ends of its lines; save what train.py prints, without --quiet")
        row = rows.setdefault(int(tested[1]), {"iteration": int(tested[1])})
        row |= {f"{tested[2]}_l1": float(tested[3]), f"{tested[2]}_psnr": float(tested[4])}
        row.setdefault("seconds", max((now - begin).total_seconds(), 1.0))
    return _make_rows(list(rows.values()), path)


def _parse_later(before: datetime | None, stamp: re.Match[str]) -> datetime:
    """Time of a stamp, which has no year: not before `before`."""
    day, month, hour, minute, second = map(int, stamp.groups())
    now = datetime(before.year if before else 2000, month, day, hour, minute, second)
    return now if before is None or now >= before - timedelta(days=1) else now.replace(year=now.year + 1)


def from_events(folder: Path) -> list[Row]:
    """Read TensorBoard's files of the reference's train.py. UserError if there are no scores.

    Seconds are those between the times at which `iter_time` was written. Where an iteration was scored between two of
    them, the median of the gaps near it counts instead.
    """
    scalars = read_scalars(folder)
    rows: dict[int, Row] = {}
    for tag, column in _COLUMNS.items():
        for scalar in scalars.get(tag, ()):
            rows.setdefault(scalar.step, {"iteration": scalar.step})[column] = scalar.value
    clock = scalars.get("iter_time", [])
    if len(clock) < 3:
        raise UserError(f"the TensorBoard files in {folder} have no iter_time; give a saved console output instead")
    seconds = _sum_training_seconds(clock, sorted(rows))
    walls = {scalar.step: scalar.wall_time for scalar in scalars.get(_SCORED, ())}
    for step, row in rows.items():
        row |= {"seconds": seconds[step]}
        if step in walls:
            row["wall_seconds"] = walls[step] - clock[0].wall_time + clock[0].step * clock[0].value / 1000
    return _make_rows(list(rows.values()), folder)


def _sum_training_seconds(clock: Sequence[ScalarEvent], scored: Sequence[int]) -> dict[int, float]:
    """Seconds until each scored iteration. clock: the times of iterations, in milliseconds, and when they were written.

    A score is written after the time of its iteration, so its pause lies in the gap that begins there.
    """
    paces = [(after.wall_time - at.wall_time) / (after.step - at.step) for at, after in pairwise(clock)]
    paused = {bisect_right(clock, step, key=lambda scalar: scalar.step) - 1 for step in scored}
    total = [clock[0].step * clock[0].value / 1000]
    for index, pace in enumerate(paces):
        if index in paused:
            around = range(max(index - NEAR, 0), min(index + NEAR + 1, len(paces)))
            pace = statistics.median([paces[i] for i in around if i not in paused] or [pace])
        total.append(total[-1] + pace * (clock[index + 1].step - clock[index].step))
    steps = [scalar.step for scalar in clock]
    return {step: total[max(bisect_right(steps, step) - 1, 0)] for step in scored}


def read_scalars(folder: Path) -> dict[str, list[ScalarEvent]]:
    """Read the scalars of all event files in a folder by tag, in the order of their steps.

    Of several at one step the one written last counts. What is damaged or cut short is left out. UserError without
    TensorBoard.
    """
    try:
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator  # takes a second
    except ImportError as error:
        raise UserError(
            f"{folder} has TensorBoard's files, and the package that reads them is missing; install tensorboard, or "
            "give a saved console output"
        ) from error
    events = EventAccumulator(str(folder), {"scalars": 0}).Reload()  # 0: all of them
    found = {}
    for tag in events.Tags()["scalars"]:
        last = {scalar.step: scalar for scalar in sorted(events.Scalars(tag), key=lambda scalar: scalar.wall_time)}
        found[tag] = [last[step] for step in sorted(last)]
    return found


def _make_rows(rows: Sequence[Row], source: Path) -> list[Row]:
    scored = [row for row in rows if row.get("test_psnr") is not None]
    if not scored:
        raise UserError(f"{source} has no scores of test views; train with --eval and --test_iterations")
    return sorted(scored, key=lambda row: row["iteration"])


def read_curve(kind: str, source: Path) -> tuple[list[Row], str]:
    """Read a peer's output, kind `gsplat` or `reference`; return its rows and what their seconds contain."""
    if not source.exists():
        raise UserError(f"there is no {source}; give the output of the other program")
    if kind == "gsplat":
        return from_gsplat(source), WITH_PAUSES
    if source.is_file():
        return from_log(source), f"{WITH_PAUSES}; they are whole seconds"
    if not list(source.glob("events.out.tfevents.*")):
        raise UserError(f"{source} has no TensorBoard files; give a saved console output instead")
    return from_events(source), WITHOUT_PAUSES


def main() -> None:
    """Write the CSV file that the command line asks for."""
    parser = ArgumentParser(
        prog="python -m applications.evaluation.peer_curve",
        description="Makes a CSV file for `full_eval.py --peer` from the output of another program.",
    )
    parser.add_argument("kind", choices=("gsplat", "reference"), help="the program")
    parser.add_argument("source", type=Path, metavar="SOURCE",
                        help="gsplat: the result folder of simple_trainer.py; reference: the model folder with "
                        "TensorBoard's files, or a file with what train.py printed")  # fmt: skip
    parser.add_argument("file", type=Path, metavar="FILE.csv", help="file to write")
    args = parser.parse_args()
    rows, note = read_curve(args.kind, args.source)
    write_peer(args.file, rows)
    print(f"wrote {len(rows)} points to {args.file}; {note}")


if __name__ == "__main__":
    run_cli(main)
