"""Options stored in a model folder: `cfg_args`, the reference's file, and `model.json`, ours."""

import argparse
import ast
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from arguments.groups import OPTIONS, ModelParams
from arguments.option import CFG_ARGS, Value
from groundwork.files import json_files
from groundwork.files.json_files import ENLARGEMENT, MODEL_JSON, OFFSET
from groundwork.files.plain_files import plain_text
from groundwork.host.machine import VERSION
from utils.system_utils import UserError, atomic_write

_IN_CFG_ARGS = {option.name: option.default for option in OPTIONS if option.stored == CFG_ARGS}
_IN_MODEL_JSON = {option.name: option.default for option in OPTIONS if option.stored == MODEL_JSON}
_OF_TRAINING = {option.name: option.default for option in OPTIONS if not option.stored and option.compared}
# Options of a model that change no picture, or whose change of it has a name of its own.
_UNSEEN = {"sh_degree", "source_path", "model_path", "data_device", "seed", "optimizer_type"}
_UNSEEN |= {option.name for option in OPTIONS if not option.seen}
# Of the views, for all saves of a model folder alike.
VIEW_OPTIONS = frozenset((_IN_CFG_ARGS.keys() | {"holdout"}) - _UNSEEN)
_OF_MODEL = {option.name for option in ModelParams.options if option.stored == MODEL_JSON}


def write_cfg_args(model_path: str | os.PathLike, args: argparse.Namespace) -> None:
    """Write `cfg_args`: one line, the repr of a Namespace with exactly the ten stored model options.

    Those that `args` lacks have their default.
    """
    values = {name: getattr(args, name, default) for name, default in _IN_CFG_ARGS.items()}
    with atomic_write(Path(model_path) / CFG_ARGS) as path:
        path.write_text(repr(argparse.Namespace(**values)), encoding="utf-8")


def read_cfg_args(model_path: str | os.PathLike) -> dict[str, Value]:
    """Read the stored model options that the file has; ignore unknown keys. Nothing in the file is executed.

    UserError if the file is missing or is anything but `Namespace(name=literal, ...)`.
    """
    path = Path(model_path) / CFG_ARGS
    if not Path(model_path).is_dir():
        wrong = "is a file, and no model folder" if os.path.isfile(model_path) else "does not exist"
        raise UserError(f"{model_path} {wrong}; pass the folder that train.py wrote as -m")
    if not path.is_file():
        raise UserError(f"no cfg_args in {model_path}; pass the folder that train.py wrote as -m")
    broken = f"{path} is not one line Namespace(name=value, ...) of plain values; restore it or train again"
    try:
        call = ast.parse(plain_text(path).strip(), mode="eval").body
    except (OSError, SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise UserError(broken) from error
    named = isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "Namespace"
    if not named or call.args or any(keyword.arg is None for keyword in call.keywords):
        raise UserError(broken)
    try:
        values = {keyword.arg: ast.literal_eval(keyword.value) for keyword in call.keywords}
    except (ValueError, TypeError, RecursionError, MemoryError) as error:
        raise UserError(broken) from error
    stored = {name: value for name, value in values.items() if name in _IN_CFG_ARGS}
    _check_types(path, stored, _IN_CFG_ARGS)
    return stored


def _check_types(path: Path, values: Mapping[str, Any], defaults: Mapping[str, Value]) -> None:
    for name, default in defaults.items():
        if name in values and type(values[name]) is not type(default):
            kind = type(default).__name__
            raise UserError(f"{path}: {name} must be {kind}, got {values[name]!r}; restore the file")


def write_model_json(
    model_path: str | os.PathLike,
    args: argparse.Namespace | None = None,
    *,
    world_offset: Sequence[float] = (0.0, 0.0, 0.0),
    enlargement: float = 1.0,
    **more: Value,
) -> None:
    """Write `model.json`, what cfg_args has no place for, with sorted keys.

    args: options; of those that belong here all are written that it has, but model options only where they differ from
    their default. The entry `options` has all others that differ from theirs. world_offset: world coordinates of
    the origin of the model's frame (scene/readers/info.py); zero writes no entry. enlargement: of the model
    where it is drawn (scene/readers/tracks.py); 1 writes no entry. more: further entries, which win.
    """
    record: dict[str, Any] = {"version": VERSION}
    for name, default in _IN_MODEL_JSON.items():
        value = getattr(args, name, None)
        if value is not None and not (name in _OF_MODEL and value == default):
            record[name] = value
    others = {name: getattr(args, name, default) for name, default in _OF_TRAINING.items()}
    record["options"] = {name: value for name, value in others.items() if value != _OF_TRAINING[name]}
    if any(world_offset):
        record[OFFSET] = list(world_offset)
    if enlargement != 1:
        record[ENLARGEMENT] = enlargement
    json_files.write_model_json(model_path, record | more)


def add_to_model_json(model_path: str | os.PathLike, **entries: Any) -> None:
    """Add entries to `model.json`, or replace those of the same names."""
    json_files.write_model_json(model_path, read_model_json(model_path) | entries)


def read_model_json(model_path: str | os.PathLike) -> dict[str, Any]:
    """Do as groundwork.files.json_files.read_model_json; UserError also for an option of the wrong type."""
    record = json_files.read_model_json(model_path)
    _check_types(Path(model_path) / MODEL_JSON, record, _IN_MODEL_JSON)
    return record


def read_stored_options(model_path: str | os.PathLike) -> dict[str, Value]:
    """Read the options that a model folder has, in cfg_args and model.json. UserError as in both readers.

    A model.json that lacks a model option stands for its default.
    """
    stored, record = read_cfg_args(model_path), read_model_json(model_path)
    if record:
        stored |= {name: _IN_MODEL_JSON[name] for name in _OF_MODEL}
    return stored | {name: record[name] for name in _IN_MODEL_JSON if name in record}


def read_training_options(model_path: str | os.PathLike) -> dict[str, Value]:
    """Do as `read_stored_options`, with the options of the training, where they were recorded."""
    others = read_model_json(model_path).get("options")
    known = _OF_TRAINING | others if isinstance(others, dict) else {}
    return known | read_stored_options(model_path)


def get_combined_args(parser: argparse.ArgumentParser, argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Parse the command line and take options that were not typed from the model folder that -m names.

    Typed options win; flags can only be switched on. UserError without -m or without a readable cfg_args. With --ply,
    the file is the model, and -m may name a folder without cfg_args, such as a new one: nothing is taken from it.

    parser: its model options must default to None (`ModelParams(parser, sentinel=True)`).
    argv: words of the command line; None: those of the program.

    Returns the options, with three attributes that no option has:

    typed_sh_degree: the --sh_degree that was typed, or None: a saved PLY may have another degree than cfg_args.
    other_scene: name of the scene that -s names, if it is not the one that the model was trained on; else empty.
    marks: ending for the names of folders of pictures, such as _r2. It lists the options, typed otherwise than stored,
        that change how views are drawn or compared, so that these pictures replace no others; empty without any.
    """
    args = parser.parse_args(argv)
    if not getattr(args, "model_path", None):
        raise UserError("no model folder given; pass it as -m")
    typed = {name: value for name, value in vars(args).items() if value is not None and value is not False}
    is_new = getattr(args, "ply", None) and not (Path(args.model_path) / CFG_ARGS).is_file()
    stored = {} if is_new else read_stored_options(args.model_path)
    other = other_scene(stored.get("source_path", ""), typed.get("source_path", ""))
    drawn = {name: value for name, value in typed.items() if not (is_new and name == "eval")}
    marks = _list_marks(_IN_CFG_ARGS | _IN_MODEL_JSON | stored, drawn)
    known = {"typed_sh_degree": typed.get("sh_degree"), "other_scene": other, "marks": "".join(marks)}
    return argparse.Namespace(**vars(args) | stored | typed | known)


def _list_marks(stored: Mapping[str, Value], typed: Mapping[str, Value]) -> Iterator[str]:
    """Yield a part of a folder's name, such as _r2, for each option that was typed otherwise than stored, sorted."""
    for name in sorted(stored.keys() & typed.keys() - _UNSEEN):
        value = typed[name]
        if value == stored[name] or (name, stored[name]) == ("appearance", "none"):  # then nothing has trained
            continue
        word = f"r{value}" if name == "resolution" else name if value is True else f"{name}_{value or 'none'}"
        yield "_" + re.sub(r"[^\w.-]+", "-", word)


def other_scene(trained: str, named: str) -> str:
    """The name of a scene that is not the one trained on; empty if it is, or if that one was moved away."""
    if not named or not os.path.isdir(trained) or os.path.realpath(trained) == os.path.realpath(named):
        return ""
    return os.path.basename(os.path.realpath(named))


def warn_of_background(options: argparse.Namespace) -> None:
    """Print a warning to stderr if options ask for a white background, but the model's cfg_args has a black one."""
    if options.white_background and read_cfg_args(options.model_path).get("white_background") is False:
        print(
            f"warning: {options.model_path} has a black background in its cfg_args, but -w asks for white; leave -w "
            "out to render it as it was trained",
            file=sys.stderr,
        )
