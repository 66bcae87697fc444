"""Reading and writing of the JSON files of this project."""

import json
from pathlib import Path
from typing import Any

from splatting.files.plain_files import plain_text
from utils.system_utils import atomic_write


def read_json(path: Path) -> Any:
    """Content of a file. OSError if it cannot be read; ValueError or RecursionError if it is not JSON."""
    return json.loads(plain_text(path))


def write_json(path: Path, content: Any, sort_keys: bool = True) -> None:
    """Write a whole file or none. ValueError for content with NaN."""
    text = json.dumps(content, indent=1, sort_keys=sort_keys, allow_nan=False, ensure_ascii=False) + "\n"
    with atomic_write(path) as temporary:
        # File names that are not UTF-8 have surrogates, which JSON escapes as Python does.
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")
