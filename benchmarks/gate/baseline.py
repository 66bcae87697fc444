"""The stored numbers of the gate, by kind of machine: a GPU's name, or a processor's family and instruction set.

On the CPU, trainings give the same bytes on every machine of a kind.
"""

import math
import platform
import re
from pathlib import Path
from typing import Any

import torch

from benchmarks.gate.judging import QUANTITIES
from splatting.files.json_files import read_json, write_json
from splatting.host.machine import instruction_set
from utils.system_utils import UserError, compute_device

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
    try:
        trainings = [run for runs in record["scenes"].values() for run in runs]
        numbers = [run[quantity.name] for run in trainings for quantity in QUANTITIES]
        known = re.fullmatch("[0-9a-f]{7,40}", record["commit"]) is not None and type(record["iterations"]) is int
        return known and bool(numbers) and all(map(math.isfinite, numbers))
    except (AttributeError, KeyError, TypeError):
        return False
