"""Our own JSON files."""

import json
from pathlib import Path
from typing import Any

from utils.system_utils import atomic_write


def read_json(path: Path) -> Any:
    """A file's content. OSError where it can't be read; ValueError or RecursionError where it is no JSON."""
    return json.loads(path.read_text(encoding="utf-8"))


def write_json(path: Path, content: Any, sort_keys: bool = True) -> None:
    """Write a file, whole or not at all, without NaN: ValueError where there is one."""
    text = json.dumps(content, indent=1, sort_keys=sort_keys, allow_nan=False, ensure_ascii=False) + "\n"
    with atomic_write(path) as temporary:
        # Names of files that are no UTF-8 have surrogates, which JSON writes just as Python does.
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")
