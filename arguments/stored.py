"""Options stored in a model folder: `cfg_args`, the reference's file, and `model.json`, ours."""

import argparse
import ast
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from arguments.groups import ModelParams
from arguments.param_group import Value
from utils.files import model_json
from utils.files.model_json import OFFSET
from utils.files.plain_files import plain_text
from utils.host.version import VERSION
from utils.system_utils import UserError, atomic_write

_STORED = {option.name: option.default for option in ModelParams.options if option.stored}
_REMEMBERED = {option.name: option.default for option in ModelParams.options if option.remembered}
_OF_TRAINING = ("antialiasing", "optimizer_type", "seed", "strategy", "resolution_schedule")


def write_cfg_args(model_path: str | os.PathLike, args: argparse.Namespace) -> None:
    """Write `cfg_args`: one line, the repr of a Namespace with exactly the ten stored model options.

    Those that `args` lacks have their default.
    """
    line = repr(argparse.Namespace(**{name: getattr(args, name, default) for name, default in _STORED.items()}))
    with atomic_write(Path(model_path) / "cfg_args") as path:
        path.write_text(line, encoding="utf-8")


def read_cfg_args(model_path: str | os.PathLike) -> dict[str, Value]:
    """Read the stored model options that the file has; ignore unknown keys. Nothing in the file is executed.

    UserError if the file is missing or is anything but `Namespace(name=literal, ...)`.
    """
    path = Path(model_path) / "cfg_args"
    if not Path(model_path).is_dir():
        raise UserError(f"no such model folder: {model_path}; pass the folder that train.py wrote as -m")
    if not path.is_file():
        raise UserError(f"no cfg_args in {model_path}; pass the folder that train.py wrote as -m")
    broken = f"{path} is not one line Namespace(name=value, ...) of plain values; restore it or train again"
    try:
        call = ast.parse(plain_text(path).strip(), mode="eval").body
    except (OSError, SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise UserError(broken) from error
    if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "Namespace"):
        raise UserError(broken)
    if call.args or any(keyword.arg is None for keyword in call.keywords):
        raise UserError(broken)
    values = {}
    for keyword in call.keywords:
        try:
            value = ast.literal_eval(keyword.value)
        except (ValueError, TypeError, RecursionError, MemoryError) as error:
            raise UserError(broken) from error
        if keyword.arg in _STORED:
            wanted = type(_STORED[keyword.arg])
            if type(value) is not wanted:
                raise UserError(f"{path}: {keyword.arg} must be {wanted.__name__}, got {value!r}; restore the file")
            values[keyword.arg] = value
    return values


def write_model_json(
    model_path: str | os.PathLike,
    args: argparse.Namespace | None = None,
    *,
    antialiasing: bool | None = None,
    seed: int | None = None,
    world_offset: Sequence[float] = (0.0, 0.0, 0.0),
    **of_training: Value,
) -> None:
    """Write `model.json`, the options that cfg_args has no place for, with sorted keys.

    args: model options; those that differ from their default are written. antialiasing, seed: None: those of `args`, or
    False and 0. world_offset: world coordinates of the origin of the model's frame (scene/readers/world_offset.py);
    zero writes no entry. of_training: other options of the training, by name.
    """
    record = {
        "antialiasing": getattr(args, "antialiasing", False) if antialiasing is None else antialiasing,
        "seed": getattr(args, "seed", 0) if seed is None else seed,
        "version": VERSION,
    }
    for name, default in _REMEMBERED.items():
        if (value := getattr(args, name, default)) != default:
            record[name] = value
    record |= of_training
    if any(world_offset):
        record[OFFSET] = list(world_offset)
    model_json.write_model_json(model_path, record)


def add_to_model_json(model_path: str | os.PathLike, **entries: Any) -> None:
    """Add entries to `model.json`, or replace those of the same names."""
    model_json.write_model_json(model_path, read_model_json(model_path) | entries)


def read_model_json(model_path: str | os.PathLike) -> dict[str, Any]:
    """Do as utils.files.model_json.read_model_json; UserError also for an option of the wrong type."""
    record = model_json.read_model_json(model_path)
    for name, default in _REMEMBERED.items():
        if type(record.get(name, default)) is not type(default):
            path = Path(model_path) / model_json.NAME
            raise UserError(f"{path}: {name} must be {type(default).__name__}, got {record[name]!r}; restore the file")
    return record


def read_stored_options(model_path: str | os.PathLike) -> dict[str, Value]:
    """Read the model options that a model folder has, in cfg_args and model.json. UserError as in both readers."""
    stored, record = read_cfg_args(model_path), read_model_json(model_path)
    return stored | {name: record[name] for name in _REMEMBERED if name in record}


def read_training_options(model_path: str | os.PathLike) -> dict[str, Any]:
    """Read all options of its training that a model folder has.

    These are the ones of cfg_args and, if there is a model.json, masks and what training.run.Run.kept adds.
    UserError as in both readers.
    """
    stored, record = read_cfg_args(model_path), read_model_json(model_path)
    if record:
        stored |= {name: record.get(name, default) for name, default in _REMEMBERED.items()}
        stored |= {name: record[name] for name in _OF_TRAINING if name in record}
    return stored


def get_combined_args(parser: argparse.ArgumentParser, argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Parse the command line and take options that were not typed from the model folder that -m names.

    Typed options win; flags can only be switched on. The parser's model options must default to None
    (`ModelParams(parser, sentinel=True)`). `typed_sh_degree` is the degree that was typed, or None, since a saved PLY
    may have another degree than cfg_args. With --ply, the folder may be a new one. UserError without -m or without a
    readable cfg_args.
    """
    args = parser.parse_args(argv)
    if not getattr(args, "model_path", None):
        raise UserError("no model folder given; pass it as -m")
    typed = {name: value for name, value in vars(args).items() if value is not None}
    is_new = getattr(args, "ply", None) and not (Path(args.model_path) / "cfg_args").is_file()
    stored = {} if is_new else read_stored_options(args.model_path)
    combined = argparse.Namespace(**{**vars(args), **stored, **typed})
    combined.typed_sh_degree = typed.get("sh_degree")
    if hasattr(args, "antialiasing"):
        remembered = read_model_json(args.model_path).get("antialiasing", False)
        combined.antialiasing = bool(args.antialiasing) or remembered
    return combined


def warn_of_background(options: argparse.Namespace) -> None:
    """Print a warning to stderr if options ask for a white background, but the model's cfg_args has a black one."""
    if options.white_background and read_cfg_args(options.model_path).get("white_background") is False:
        print(
            f"warning: {options.model_path} has a black background in its cfg_args, but -w asks for white; leave -w "
            "out to render it as it was trained",
            file=sys.stderr,
        )
