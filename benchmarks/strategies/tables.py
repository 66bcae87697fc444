"""Tables of strategies beside the default, and of time budgets beside the best fixed setting at their time.

    python -m benchmarks.strategies.tables OUT/trainings.json ...

Several files of the same commit and machine are read as one.
"""

import argparse
import json
import math
import statistics
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from splatting.files.listing import markdown_table
from utils.system_utils import UserError, run_cli

DEFAULT = "adc"
BUDGET = "--time_budget"
_COSTS = ["scene", "options", "seeds", "iterations", "seconds", "Gaussians"]
_SCORES = ["seconds of adc's", "MB", "test PSNR (dB)", "more than adc", "best of its curve", "train PSNR"]


def print_tables(found: dict) -> None:
    """Print the machine and all tables that the trainings allow."""
    print(found["machine"])
    print("\n".join(["", *(f"- {name}: `{' '.join(words)}`" for name, words in found["sets"].items() if words), ""]))
    if DEFAULT in found["sets"]:
        rows = [row for scene in found["scenes"] for row in _against(found, scene)]
        print(markdown_table([*_COSTS, *_SCORES], rows))
        print(f"\n{_means(found)}")
    if budgets := {name: float(given) for name, words in found["sets"].items() if (given := _given(words))}:
        print(f"\n{_beside_fronts(found, budgets)}")


def _given(words: Sequence[str]) -> str:
    """The seconds that a set's options give; nothing for a part of the default's."""
    after = "".join(words[words.index(BUDGET) + 1 :][:1]) if BUDGET in words else ""
    return "" if "%" in after else after


def _ends(found: dict, scene: str, name: str) -> list[dict]:
    """The ends of a set's trainings, of the seeds that have one."""
    return [one["end"] | one for one in found["scenes"][scene].get(name, {}).values() if one]


def _costs(ends: list[dict]) -> list[str]:
    forms = {"iteration": ",.0f", "seconds": ".2f", "gaussians": ",.0f"}
    return [f"{len(ends)}", *(_shown([end[key] for end in ends], form) for key, form in forms.items())]


def _mean(ends: list[dict], key: str) -> float:
    return statistics.fmean(end[key] for end in ends)


def _against(found: dict, scene: str) -> list[list[str]]:
    """A row for each set: what it costs and how well it ends, beside the default."""
    rows = []
    default = _ends(found, scene, DEFAULT)
    for name in found["sets"]:
        if ends := _ends(found, scene, name):
            part = f"{_mean(ends, 'seconds') / _mean(default, 'seconds'):.2f}" if default else ""
            more = f"{gain(found, scene, name):+.2f}" if default else ""
            best = statistics.fmean(max(row["test_psnr"] for row in end["curve"] if row["whole"]) for end in ends)
            row = [scene, name, *_costs(ends), part, f"{_mean(ends, 'ply_bytes') / 1e6:.1f}"]
            row += [_shown([end["test_psnr"] for end in ends], ".2f"), more, f"{best:.2f}"]
            rows.append([*row, f"{_mean(ends, 'train_psnr'):.2f}"])
    return rows


def gain(found: dict, scene: str, name: str) -> float:
    """What the mean test PSNR (dB) of a set is above the default's."""
    ours, theirs = (_mean(_ends(found, scene, one), "test_psnr") for one in (name, DEFAULT))
    return ours - theirs


def _shown(values: Sequence[float], form: str) -> str:
    deviation = f" ± {statistics.stdev(values):{form}}" if len(values) > 1 else ""
    return f"{statistics.fmean(values):{form}}{deviation}"


def _means(found: dict) -> str:
    """A table of the mean gain over the scenes that have a set."""
    rows = []
    for name in found["sets"]:
        scenes = [scene for scene in found["scenes"] if _ends(found, scene, name) and _ends(found, scene, DEFAULT)]
        if scenes and name != DEFAULT:
            gains = [gain(found, scene, name) for scene in scenes]
            rows.append([name, f"{len(scenes)}", f"{statistics.fmean(gains):+.2f}", f"{min(gains):+.2f}"])
    return markdown_table(["options", "scenes", "mean of more than adc (dB)", "least"], rows)


def _beside_fronts(found: dict, budgets: dict[str, float]) -> str:
    """A table of time budgets (seconds): PSNR at their end, and the best of the sets without one at that time."""
    rows = []
    for scene in found["scenes"]:
        for name, given in budgets.items():
            ends = _ends(found, scene, name)
            fixed = {
                other: statistics.fmean(at(end["curve"], given) for end in ended)
                for other, words in found["sets"].items()
                if BUDGET not in words and (ended := _ends(found, scene, other))
            }
            if ends and fixed:
                best = max(fixed, key=fixed.__getitem__)
                psnr = _shown([end["test_psnr"] for end in ends], ".2f")
                more = f"{_mean(ends, 'test_psnr') - fixed[best]:+.2f}"
                rows.append([scene, name, *_costs(ends), psnr, f"{fixed[best]:.2f}", best, more])
    return markdown_table([*_COSTS, "test PSNR (dB)", "best fixed one then", "options of that", "more"], rows)


def at(curve: Sequence[dict], seconds: float) -> float:
    """Test PSNR (dB) of a curve at a time: between two points on the line between them, after the end that of the end.

    Only points that score all test views count. Before the first one it is minus infinity.
    """
    points = [(row["seconds"], row["test_psnr"]) for row in curve if row["whole"]]
    return float(np.interp(seconds, *zip(*points, strict=True), left=-math.inf)) if points else -math.inf


def joined(files: Sequence[dict]) -> dict:
    """One record of several: sets and scenes of all. UserError if a set has other options in another file."""
    machines = dict.fromkeys(one["machine"] for one in files)
    whole = {"machine": "\n".join(machines), "sets": {}, "scenes": {}}
    for one in files:
        for name, words in one["sets"].items():
            if whole["sets"].setdefault(name, words) != words:
                raise UserError(f"set {name} has other options in another file; give files of the same --sets")
        for scene, sets in one["scenes"].items():
            for name, seeds in sets.items():
                ended = {seed: run for seed, run in seeds.items() if run}
                whole["scenes"].setdefault(scene, {}).setdefault(name, {}).update(ended)
    return whole


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", type=Path, nargs="+", help="trainings.json of benchmarks.strategies.trainings")
    print_tables(joined([json.loads(path.read_text()) for path in parser.parse_args().files]))


if __name__ == "__main__":
    run_cli(main)
