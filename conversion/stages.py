"""What of a conversion is done, so that a second run does only the rest."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from utils.files.json_files import read_json, write_json
from utils.system_utils import UserError


class Stage(NamedTuple):
    """One step. made_from: what its result depends on besides the earlier stages (JSON).

    reset: removes its results as far as they are of no use once an earlier stage is done again. check: UserError for
    inputs that can't be worked on, before anything is removed. resumable: work can go on where an interrupted run with
    the same inputs stopped, without a reset.
    """

    name: str
    made_from: Any
    reset: Callable[[], None]
    work: Callable[[], None]
    resumable: bool = False
    check: Callable[[], None] = lambda: None


class StageRecord:
    """stages.json: for each stage begun, a digest of all that it was made from, and whether it was finished."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._record: dict[str, dict[str, Any]] = {}
        if path.is_file():
            try:
                self._record = read_json(path)
                done = {name: entry["done"] and entry["made_from"] for name, entry in self._record.items()}
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                raise UserError(
                    f"{path} is damaged; remove the folder {path.parent} to convert from the beginning"
                ) from error
            del done

    def begun(self, name: str) -> bool:
        """Whether this stage was ever begun here."""
        return name in self._record

    def run(self, stages: list[Stage]) -> list[str]:
        """Do what is not done, in order; names of the stages that were done before.

        The first stage whose inputs changed, or that was never finished, is done again with all that follow.
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
                    self._record[later.name]["done"] = False  # still begun: what is left of it is ours
            self._save()
            # Backwards: what was made last goes first.
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
