"""Results of earlier calls in the same output folder, which a report goes on showing."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from evaluation.runs import Run, is_model
from evaluation.scenes import SceneEntry
from evaluation.stages import Failure
from utils.files.json_files import read_json

NAME = "report.json"


@dataclass(frozen=True)
class Earlier:
    """What the report in an output folder shows: runs and failures by model folder, peers, commands.

    scored: whether it has any score.
    """

    runs: dict[Path, tuple[Run, Failure | None]] = field(default_factory=dict)
    peers: list[dict[str, Any]] = field(default_factory=list)
    commands: list[list[str]] = field(default_factory=list)
    scored: bool = False


def read_earlier(output: Path) -> Earlier:
    """Read the report of an output folder; empty without one. Runs whose model folder is gone are left out."""
    path = output / NAME
    if not path.is_file():
        return Earlier()
    try:
        report = read_json(path)
        runs = [_run(content, output) for content in report["runs"]]
        manifest = report["manifest"]
        commands = [list(map(str, words)) for words in [*manifest.get("earlier_commands", []), manifest["command"]]]
        return Earlier(
            {run.model: (run, failure) for run, failure in runs if is_model(run.model)},
            list(report.get("peers", [])),
            commands,
            bool(report["summary"]),
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        print(f"warning: {path} is damaged ({error}); a new report is started", file=sys.stderr)
        return Earlier()


def _run(content: dict[str, Any], output: Path) -> tuple[Run, Failure | None]:
    source = content["source"]
    scene = SceneEntry(content["scene"], content["group"], source and Path(source))
    options, added = tuple(content["options"] or ()), tuple(content["added_options"] or ())
    run = Run(scene, content["config"], content["seed"], output / content["model"], options, added)
    return run, Failure(**content["failure"]) if content["failure"] else None


def joined(earlier: Earlier, runs: Sequence[Run], failures: dict[Run, Failure]) -> list[tuple[Run, Failure | None]]:
    """Return earlier runs and those of this call, with their failures; a run of both is that of this call."""
    ours = {run.model: (run, failures.get(run)) for run in runs}
    return list((earlier.runs | ours).values())


def joined_peers(earlier: Earlier, peers: Sequence[dict[str, Any]], scenes: set[str]) -> list[dict[str, Any]]:
    """Return earlier peers of the scenes and those of this call; a peer of both is that of this call."""
    every = {(peer["scene"], peer["name"]): peer for peer in (*earlier.peers, *peers)}
    return [peer for peer in every.values() if peer["scene"] in scenes]
