"""The stored numbers of the gate, and judgement of new ones by them.

Stored numbers are those of a kind of machine: a GPU's name, or a processor's family and instruction set. On the CPU,
trainings give the same bytes on every machine of a kind.
"""

import math
import platform
import re
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch

from groundwork.files.json_files import read_json, write_json
from groundwork.host.machine import instruction_set
from utils.system_utils import UserError, compute_device

DEVIATIONS = 3  # of single trainings over the stored seeds
MOST_TIME = 1.10  # seconds of this code over those of the stored build
HEADER = ["scene", "quantity", "stored", "found", "change", "allowed", ""]


class Quantity(NamedTuple):
    """A number of a training. least: the smallest deviation to reckon with, since few seeds can agree by chance."""

    name: str
    worse: int  # 1: more is worse, -1: less is worse
    least: float
    relative: bool  # `least` is a share of the stored mean
    digits: int


QUANTITIES = (
    Quantity("PSNR", -1, 0.02, False, 3),  # dB
    Quantity("SSIM", -1, 0.0003, False, 5),
    Quantity("Gaussians", 1, 0.002, True, 0),
    Quantity("bytes", 1, 0.002, True, 0),  # of the PLY
)


class Row(NamedTuple):
    """A quantity of a scene. change: above 0 is worse."""

    scene: str
    name: str
    stored: float
    found: float
    change: float
    allowed: float
    digits: int

    @property
    def passed(self) -> bool:
        """Tell if the change is allowed; False where a number is not finite."""
        return self.change <= self.allowed

    def cells(self) -> list[str]:
        """Return the cells of the table, in the order of HEADER."""
        numbers = (f"{value:,.{self.digits}f}" for value in (self.stored, self.found))
        moved = f"{self.found - self.stored:+,.{self.digits}f}", f"{self.allowed:,.{self.digits}f}"
        return [self.scene, self.name, *numbers, *moved, "" if self.passed else "WORSE"]


def judge_quality(scene: str, stored: Sequence[Mapping], found: Sequence[Mapping]) -> list[Row]:
    """Compare the means of a scene's trainings. stored: two or more seeds; found: one or more."""
    rows = []
    for name, worse, least, relative, digits in QUANTITIES:
        before, now = [run[name] for run in stored], [run[name] for run in found]
        mean = statistics.mean(before)
        deviation = max(statistics.stdev(before), least * mean if relative else least)
        change = worse * (statistics.mean(now) - mean)
        rows.append(Row(scene, name, mean, statistics.mean(now), change, DEVIATIONS * deviation, digits))
    return rows


def judge_time(scene: str, pairs: Sequence[tuple[float, float]]) -> Row:
    """Compare seconds of this code and of the stored build, one pair for each seed, by their mean ratio."""
    ratio = math.exp(statistics.mean(math.log(now / before) for now, before in pairs))
    return Row(scene, "seconds, ratio", 1.0, ratio, ratio - 1, MOST_TIME - 1, 3)


FILE = Path(__file__).resolve().parents[1] / "gate.json"


def machine_kind() -> str:
    """Return the kind of this machine."""
    device = compute_device()
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"CPU {platform.machine()} {instruction_set()}"


def read_baseline(path: Path, kind: str, scenes: list[str], iterations: int) -> dict[str, Any]:
    """Return the record of a kind: `commit`, `iterations`, and for each of `scenes` its trainings.

    The file may have more scenes. UserError if there is no record, if it is broken, or of other scenes or iterations.
    """
    again = f"write it at a commit that is known to be good: python -m benchmarks.gate --write --baseline {path}"
    try:
        records = read_json(path)
    except FileNotFoundError:
        records = {}
    except ValueError as error:
        raise UserError(f"{path} is not JSON; restore it, or {again}") from error
    record = records.get(kind) if isinstance(records, dict) else None
    if record is None:
        raise UserError(f"{path} has no baseline of this kind of machine ({kind}); {again}")
    if not _is_whole(record):
        raise UserError(f"{path} has a broken baseline for {kind}; restore the file, or {again}")
    if not set(scenes) <= set(record["scenes"]) or record["iterations"] != iterations:
        there, here = ", ".join(sorted(record["scenes"])), ", ".join(sorted(scenes))
        raise UserError(
            f"the baseline for {kind} is of {there} at {record['iterations']} iterations, not of {here} at "
            f"{iterations}; {again}"
        )
    return record | {"scenes": {name: record["scenes"][name] for name in scenes}}


def write_baseline(path: Path, kind: str, record: dict[str, Any]) -> None:
    """Store the record of a kind beside those of other kinds, whole or not at all.

    Scenes that are stored of the same commit and number of iterations stay beside its own.
    """
    records = read_json(path) if path.exists() else {}
    before = records.get(kind, {})
    if all(before.get(key) == record[key] for key in ("commit", "iterations")):
        record = record | {"scenes": before["scenes"] | record["scenes"]}
    write_json(path, records | {kind: record})


def _is_whole(record: Any) -> bool:
    """Tell whether a stored record has a commit, iterations and finite numbers of all trainings."""
    try:
        trainings = [run for runs in record["scenes"].values() for run in runs]
        numbers = [run[quantity.name] for run in trainings for quantity in QUANTITIES]
        known = re.fullmatch("[0-9a-f]{7,40}", record["commit"]) is not None and type(record["iterations"]) is int
        return known and bool(numbers) and all(map(math.isfinite, numbers))
    except (AttributeError, KeyError, TypeError):
        return False
