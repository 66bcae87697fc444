"""Comparison with published tables (published.json, each with its source)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from splatting.files.json_files import read_json

COMPARED = ("PSNR", "SSIM", "LPIPS", "gaussians")


def published_tables() -> list[dict[str, Any]]:
    """Read the published tables.

    A table has name, source, hardware and note. `groups` and `requires` tell which runs can be compared with it.
    `scenes` and `means` (of a group) have numbers by iteration. LPIPS: VGG on [0, 1]; seconds: on that hardware.
    """
    return read_json(Path(__file__).parent / "published.json")["tables"]


def compare(
    runs: Sequence[dict[str, Any]], rows: Sequence[dict[str, Any]], means: Sequence[dict[str, Any]]
) -> list[dict[str, Any]]:
    """Compare our numbers with each published one of the same scene (or mean of a data set) and iteration.

    runs, rows, means: those of report.json (`runs`, `summary`, `dataset_means`). In the result, `other_options` has the
    options of our training that the table's did not have (null: not known); they may explain a difference.
    """
    compared = []
    for table in published_tables():
        for row in rows:
            run = next(run for run in runs if (run["scene"], run["config"]) == (row["scene"], row["config"]))
            theirs = table["scenes"].get(row["scene"], {}).get(str(None if row["open_ended"] else row["iteration"]))
            if theirs and row["group"] in table["groups"] and _meets(run, table.get("requires", {})):
                ours = {name: row[name]["mean"] for name in COMPARED}
                compared.append(_comparison(table, row | ours, row["scene"], theirs, run))
        for mean in means:
            theirs = table["means"].get(mean["group"], {}).get(str(mean["iteration"]))
            if theirs:
                run = next(run for run in runs if (run["group"], run["config"]) == (mean["group"], mean["config"]))
                compared.append(_comparison(table, mean, f"mean of {mean['group']}", theirs, run))
    return compared


def _meets(run: dict[str, Any], wanted: dict[str, Any]) -> bool:
    return (
        run["test_sizes"] == wanted.get("test_sizes", run["test_sizes"])
        and run["views"]["test"] == wanted.get("test_views", run["views"]["test"])
        and set(wanted.get("options", ())) <= set(run["options"] or ())
    )


def _comparison(
    table: dict[str, Any], ours: dict[str, Any], scene: str, theirs: dict[str, float], run: dict[str, Any]
) -> dict[str, Any]:
    numbers = {
        name: {"difference": ours[name] - theirs[name], "ours": ours[name], "published": theirs[name]}
        for name in COMPARED
        if name in theirs and ours[name] is not None
    }
    facts = {"config": ours["config"], "iteration": ours["iteration"], "other_options": run["added_options"]}
    return facts | {"numbers": numbers, "scene": scene, "table": table["name"]}
