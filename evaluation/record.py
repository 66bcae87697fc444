"""full_eval.json in a model folder: which stages are finished, with what, where and in how many seconds."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from utils.files.json_files import read_json, write_json

NAME = "full_eval.json"


class Record:
    """What full_eval.py knows of a model folder: `key` (Run.key, None for models of others) and finished stages."""

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
                print(f"warning: {self._path} is damaged, so nothing there counts as finished", file=sys.stderr)

    @property
    def key(self) -> dict[str, Any] | None:
        return self._content.get("key")

    def stage(self, name: str) -> dict[str, Any] | None:
        """What was noted when the stage `name` ended well; None where it has not."""
        return self._content.get("stages", {}).get(name)

    def start(self, key: dict[str, Any]) -> None:
        """Note what is going to be trained here."""
        if self.key != key:
            self._content = {"key": key, "stages": {}}
            self._write()

    def note(self, name: str, **values: Any) -> None:
        """A stage has ended well (or, for training, was interrupted or failed): remember it."""
        self._content.setdefault("key", None)
        self._content.setdefault("stages", {})[name] = values
        self._write()

    def _write(self) -> None:
        write_json(self._path, self._content)
