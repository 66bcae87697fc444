"""JSON files, and `model.json` of a model folder: entries that the reference's `cfg_args` has no place for.

arguments/stored.py says which options are in it.
"""

import json
import os
import re
from pathlib import Path
from typing import Any

from groundwork.files.plain_files import plain_text
from groundwork.files.writing import atomic_write
from groundwork.host.errors import UserError

_BACKSLASH = re.compile(r'\\(?:[\\"/]|u[0-9a-fA-F]{4})?')  # with what it escapes in a text that has lone ones
MODEL_JSON = "model.json"
SCHEDULE = "schedule.json"  # of a training whose iterations stand for more or fewer than themselves
OFFSET = "world_offset"  # (3,) world coordinates of the origin of the model's frame (scene/readers/info.py)
ENLARGEMENT = "enlargement"  # of the model where it is drawn (scene/readers/tracks.py)
LARGEST_OFFSET = 1e15  # beyond, the steps of doubles are larger than 0.1


def read_json(path: Path) -> Any:
    """Content of a file. OSError if it cannot be read; ValueError or RecursionError if it is not JSON.

    A backslash that begins no escape stands for itself, as in paths that were written by hand on Windows.
    """
    text = plain_text(path)
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        if not error.msg.startswith("Invalid \\"):
            raise
    return json.loads(_BACKSLASH.sub(lambda found: found[0] if len(found[0]) > 1 else "\\\\", text))


def write_json(path: Path, content: Any, sort_keys: bool = True) -> None:
    """Write a whole file or none. ValueError for content with NaN."""
    text = json.dumps(content, indent=1, sort_keys=sort_keys, allow_nan=False, ensure_ascii=False) + "\n"
    with atomic_write(path) as temporary:
        # File names that are not UTF-8 have surrogates, which JSON escapes as Python does.
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def read_model_json(model_path: str | os.PathLike) -> dict[str, Any]:
    """Read `model.json`; {} if there is none, as in a model of another program.

    UserError if it is no JSON object, or if its antialiasing, world_offset or enlargement is broken.
    """
    path = Path(model_path) / MODEL_JSON
    if not path.is_file():
        return {}
    try:
        record = read_json(path)
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"{path} is not JSON; restore it, or remove it and pass --antialiasing yourself") from error
    if not isinstance(record, dict) or not isinstance(record.get("antialiasing", False), bool):
        raise UserError(f"{path}: antialiasing must be true or false; restore the file, or remove it")
    offset = record.get(OFFSET, [0, 0, 0])
    if not isinstance(offset, list) or len(offset) != 3 or not all(_is_coordinate(value) for value in offset):
        raise UserError(
            f"{path}: {OFFSET} must be three numbers to {LARGEST_OFFSET:g}, got {offset!r:.40}; restore the file"
        )
    factor = record.get(ENLARGEMENT, 1.0)
    if not (_is_coordinate(factor) and factor > 0):
        fault = f"must be a number above 0, to {LARGEST_OFFSET:g}, got {factor!r:.40}"
        raise UserError(f"{path}: {ENLARGEMENT} {fault}; restore the file")
    return record


def write_model_json(model_path: str | os.PathLike, record: dict[str, Any]) -> None:
    """Write `model.json` with sorted keys, whole or not at all."""
    write_json(Path(model_path) / MODEL_JSON, record)


def _is_coordinate(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) <= LARGEST_OFFSET
