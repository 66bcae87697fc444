"""Keeps where a scene stands upright, which convert.py --orient found, in model.json for exports."""

import argparse
import os
from typing import Any

from splatting.part import Part


class Upright(Part):
    """Takes part where the scene has such a record. The training itself does not change."""

    name = "upright"
    _record: dict[str, Any] | None = None

    @classmethod
    def wanted(cls, given: argparse.Namespace) -> bool:
        from splatting.files.similarity import FILE

        return os.path.isfile(os.path.join(getattr(given, "source_path", "") or "", FILE))

    @classmethod
    def asked_by(cls, given: argparse.Namespace) -> str:
        return "orientation of the scene"

    def check(self, run: Any, state: Any) -> None:
        from pathlib import Path

        from splatting.files.similarity import read_orientation

        self._record = read_orientation(Path(run.dataset.source_path))

    def facts(self) -> dict[str, Any]:
        from splatting.files.similarity import ENTRY

        return {} if self._record is None else {ENTRY: self._record}
