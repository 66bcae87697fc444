"""The file full_eval.json in a model folder: finished stages with their inputs, machine and seconds."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from utils.files.json_files import read_json, write_json

NAME = "full_eval.json"


class Record:
    """full_eval.py's record of a model folder: `key` (Run.key, None if others made the model) and finished stages."""

    def __init__(self, model: Path) -> None:
        self._path = model / NAME
        self._content: dict[str, Any] = {}
        if self._path.is_file():
            try:
                content = read_json(self._path)
                if not isinstance(content["stages"], dict) or not isinstance(content["key"], dict | None):
                    raise ValueError
                self._content = content
            except (OSError, ValueError, KeyError, TypeError, RecursionError):
                print(f"warning: {self._path} is damaged; its stages will be repeated", file=sys.stderr)

    @property
    def key(self) -> dict[str, Any] | None:
        return self._content.get("key")

    def stage(self, name: str) -> dict[str, Any] | None:
        """Return the notes of a stage that succeeded; None if it did not."""
        return self._content.get("stages", {}).get(name)

    def start(self, key: dict[str, Any]) -> None:
        """Note the key of the training that starts here; another key discards the old stages."""
        if self.key != key:
            self._content = {"key": key, "stages": {}}
            self._write()

    def note(self, name: str, **values: Any) -> None:
        """Note that a stage succeeded, or that training was interrupted or failed."""
        self._content.setdefault("key", None)
        self._content.setdefault("stages", {})[name] = values
        self._write()

    def _write(self) -> None:
        write_json(self._path, self._content)
