"""Stages of a conversion and the record of finished ones, so that a second run does only the rest."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from utils.files.json_files import read_json, write_json
from utils.system_utils import UserError


class Stage(NamedTuple):
    """One step of a conversion.

    made_from: JSON of everything that its result depends on, besides the earlier stages. reset: removes results that
    become invalid when this or an earlier stage is done again. check: raises UserError for unusable inputs, before
    anything is removed. resumable: `work` can resume an interrupted run with the same inputs, without a reset.
    """

    name: str
    made_from: Any
    reset: Callable[[], None]
    work: Callable[[], None]
    resumable: bool = False
    check: Callable[[], None] = lambda: None


class StageRecord:
    """The file stages.json. It has, for each stage begun, a digest of its inputs and whether it was finished."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._record: dict[str, dict[str, Any]] = {}
        if path.is_file():
            try:
                self._record = read_json(path)
                done = {name: entry["done"] and entry["made_from"] for name, entry in self._record.items()}
            except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
                raise UserError(
                    f"{path} is damaged; remove the folder {path.parent} to convert from the beginning"
                ) from error
            del done

    def begun(self, name: str) -> bool:
        """Whether this stage was ever begun in this folder."""
        return name in self._record

    def run(self, stages: list[Stage]) -> list[str]:
        """Do the stages that are not done, in order; return the names of those that were done before.

        The first stage whose inputs changed or that was never finished is done again, with all later ones.
        """
        digest, kept = "", []
        for number, stage in enumerate(stages):
            text = json.dumps([digest, stage.name, stage.made_from], sort_keys=True)
            digest = hashlib.sha256(text.encode()).hexdigest()[:16]
            before = self._record.get(stage.name, {})
            same = before.get("made_from") == digest
            if same and before["done"]:
                kept.append(stage.name)
                continue
            stage.check()
            for later in stages[number:]:
                if later.name in self._record:
                    self._record[later.name]["done"] = False  # but still begun: remaining files of it are ours
            self._save()
            # Reset backwards, so that the newest results go first.
            for later in reversed(stages[number:]):
                if later is not stage or not (same and stage.resumable):
                    later.reset()
            self._record[stage.name] = {"made_from": digest, "done": False}
            self._save()
            stage.work()
            self._record[stage.name]["done"] = True
            self._save()
        return kept

    def _save(self) -> None:
        write_json(self._path, self._record)
