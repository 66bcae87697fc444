"""Named option sets for train.py, read from --configs FILE or one of the files in sets/."""

from __future__ import annotations

import contextlib
import io
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path

from groundwork.files.plain_files import plain_text
from utils.system_utils import UserError

LONGEST = 100  # bytes of a name, which is also part of a figure's name
Parse = Callable[[Sequence[str]], object]
SHIPPED = Path(__file__).parent / "sets"
_SHAPE = 'like {"base": [], "sh1": ["--sh_degree", "1"]}'


def list_shipped() -> list[str]:
    """List the names of the files in sets/, which --configs takes."""
    return sorted(file.stem for file in SHIPPED.glob("*.json"))


def read_configs(path: Path, parse: Parse | None) -> dict[str, tuple[str, ...]]:
    """Read the option sets of a JSON file, {name: [word, ...]}, in its order. A word may also be a number.

    path: of the file, or if there is none, the name of one in sets/, without its ending. parse: see `check_options`.
    UserError for any other content, or for words that train.py does not accept.
    """
    if not path.is_file() and str(path) in list_shipped():
        path = SHIPPED / f"{path}.json"
    try:
        content = json.loads(plain_text(path), object_pairs_hook=_refuse_duplicates)
    except OSError as error:
        raise UserError(
            f"cannot read {path} ({error.strerror}); --configs takes a JSON file {_SHAPE}, or "
            f"{' or '.join(list_shipped())}"
        ) from error
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is not a table of option sets ({error}); write it {_SHAPE}") from error
    if not isinstance(content, dict) or not content:
        raise UserError(f"{path} names no option sets; write it {_SHAPE}")
    configs = {}
    for name, words in content.items():
        # The name becomes a folder, so it must not be one that a seed or train.py makes.
        if len(name.encode()) > LONGEST:
            raise UserError(f"{path}: the name {name[:20]}... is too long for a folder; use at most {LONGEST} letters")
        if not re.fullmatch(r"[A-Za-z0-9][\w.+-]*", name) or re.fullmatch(r"seed_\d+|point_cloud|test|train", name):
            raise UserError(f"{path}: {name!r} cannot name a folder; use letters, digits, _ . + -")
        if not isinstance(words, list) or not all(type(word) in (str, int, float) for word in words):
            raise UserError(f"{path}: {name} must be a list of words for train.py, {_SHAPE}")
        configs[name] = tuple(str(word) for word in words)
        check_options(configs[name], f"{path}, {name}", parse)
    return configs


def _refuse_duplicates(pairs: list[tuple[str, object]]) -> dict[str, object]:
    names = [name for name, _ in pairs]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"it has {twice[0]} twice")
    return dict(pairs)


def check_options(words: Sequence[str], where: str, parse: Parse | None) -> None:
    """Check options before other trainings have taken hours.

    parse: train.py's parser; None if nothing is trained. UserError for options that full_eval.py sets itself (data,
    model folder, checkpoint) and for options that train.py would refuse.
    """
    for word in words:
        name = word.split("=")[0]
        taken = name[:2] in ("-s", "-m") or any(
            len(name) > 4 and long.startswith(name) for long in ("--source_path", "--model_path", "--start_checkpoint")
        )
        if taken:
            raise UserError(f"{where}: full_eval.py sets {word} itself; omit it")
    if not words or not parse:
        return
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            found = parse(words)
    except SystemExit as error:  # raised by argparse; without a message for -h
        line = said.getvalue().strip().rpartition("error: ")[2]  # and where to find all options, which follows
        reason = line.rpartition(" (")[0] or f"{' '.join(words)} trains nothing"
        raise UserError(f"{where}: {reason}; train.py --help-all lists the options") from error
    except UserError as error:
        raise UserError(f"{where}: {error}") from error
    args = found[0] if isinstance(found, tuple) else None
    if getattr(args, "advise", False):
        raise UserError(f"{where}: --advise trains nothing; give --options auto to follow it, or run train.py --advise")
    if getattr(args, "viewer", None) is not None:
        raise UserError(f"{where}: --viewer waits for its page to be closed; leave it out")
