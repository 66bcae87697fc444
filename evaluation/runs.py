"""What one training is: a scene under one option set with one seed, into a model folder of its own."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from arguments import OptimizationParams
from evaluation.record import Record
from evaluation.scenes import SceneEntry
from utils.system_utils import UserError

_DEFAULT_ITERATIONS = next(option.default for option in OptimizationParams.options if option.name == "iterations")


@dataclass(frozen=True)
class Run:
    """One training. `options`: train.py's words besides folders and silence; `added`: those that its table lacks."""

    scene: SceneEntry
    config: str | None
    seed: int | None
    model: Path
    options: tuple[str, ...]
    added: tuple[str, ...]

    @property
    def title(self) -> str:
        """For people: scene, option set, seed."""
        seed = None if self.seed is None else f"seed {self.seed}"
        return ", ".join(part for part in (self.scene.name, self.config, seed) if part)

    @property
    def key(self) -> dict[str, object]:
        """What must be the same for a finished training to stand: the scene's folder and train.py's options."""
        return {"options": list(self.options), "scene": self.scene.source and str(self.scene.source)}

    @property
    def iterations(self) -> int | None:
        """The last iteration, from the options; None where they are wrong (train.py says how)."""
        parser = argparse.ArgumentParser(add_help=False, exit_on_error=False)
        parser.add_argument("--iterations", type=int, default=_DEFAULT_ITERATIONS)
        try:
            return parser.parse_known_args(list(self.options))[0].iterations
        except argparse.ArgumentError:
            return None


def plan_runs(
    scenes: Sequence[SceneEntry],
    output: Path,
    common: Sequence[str],
    configs: Mapping[str, Sequence[str]],
    seeds: Sequence[int],
) -> list[Run]:
    """Every scene under every option set with every seed; empty `configs` or `seeds`: plain, without a folder for it.

    common: train.py's words for all of them. Folders: output/<scene>[/<config>][/seed_N].
    """
    runs = []
    for scene in scenes:
        for config, words in configs.items() or [(None, ())]:
            for seed in seeds or [None]:
                model = output / scene.name
                model = model / config if config else model
                model = model if seed is None else model / f"seed_{seed}"
                added = (*common, *words)
                seeded = () if seed is None else ("--seed", str(seed))
                options = ("--eval", "--test_iterations", "-1", *scene.options, *added, *seeded)
                runs.append(Run(scene, config, seed, model, options, added))
    return runs


def check_outside_scenes(runs: Sequence[Run]) -> None:
    """UserError where a model folder, and so perhaps the report, would lie in a scene's: nothing is written there."""
    sources = {run.scene.source.resolve() for run in runs if run.scene.source}
    for run in runs:
        for source in sources:
            if run.model.is_relative_to(source):
                raise UserError(
                    f"the model folder {run.model} would lie in the scene folder {source}; choose another --output_path"
                )


def check_folders(runs: Sequence[Run]) -> None:
    """UserError where a model folder holds another training: nothing is overwritten, and nothing is mixed."""
    for run in runs:
        record = Record(run.model)
        if record.key is None:
            if (run.model / "point_cloud").exists() or list(run.model.glob("chkpnt*.pth")):
                raise UserError(
                    f"{run.model} holds a model that full_eval.py has not trained; --skip_training scores it as it is, "
                    "or choose another --output_path"
                )
        elif record.key != run.key:
            raise UserError(
                f"{run.model} was trained with other options or data ({_differences(record.key, run.key)}); choose "
                "another --output_path, or remove that folder"
            )


def _differences(there: dict, asked: dict) -> str:
    if there.get("scene") != asked["scene"]:
        return f"scene {there.get('scene')}, asked for {asked['scene']}"
    return f"{' '.join(map(str, there.get('options', [])))}; asked for {' '.join(asked['options'])}"
