"""Plan of the runs: each trains a scene with one option set and one seed into its own model folder, with a record.

A scene is one of the method's three data sets, with its options there, or any folder.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arguments import OptimizationParams
from groundwork.files.json_files import read_json, write_json
from splatting.registry import PARTS
from utils.system_utils import UserError

_OUTDOOR = ("-i", "images_4")
_INDOOR = ("-i", "images_2")

# Photos on which Kerbl et al. 2023 trained: a quarter of the size for Mip-NeRF 360 outdoors, half of it indoors.
DATASETS: dict[str, dict[str, tuple[str, ...]]] = {
    "mipnerf360": {
        **dict.fromkeys(("bicycle", "flowers", "garden", "stump", "treehill"), _OUTDOOR),
        **dict.fromkeys(("room", "counter", "kitchen", "bonsai"), _INDOOR),
    },
    "tanksandtemples": dict.fromkeys(("truck", "train"), ()),
    "deepblending": dict.fromkeys(("drjohnson", "playroom"), ()),
}
FOLDERS = "scenes"  # group of the folders given as --scenes
RESERVED = {"figures"}  # folders of the report, next to the models

_DEFAULT_ITERATIONS = next(option.default for option in OptimizationParams.options if option.name == "iterations")

RECORD = "full_eval.json"  # in a model folder: finished stages with their inputs, machine and seconds
ENDING = [option for part in PARTS for option in part.ends_by]  # they end a training by themselves


@dataclass(frozen=True)
class SceneEntry:
    """A scene: `source` is its folder, None if only a finished model is scored; `options` are words for train.py."""

    name: str
    group: str
    source: Path | None
    options: tuple[str, ...] = ()


def dataset_scenes(group: str, root: Path, resize: bool = False) -> list[SceneEntry]:
    """List the scenes of one of DATASETS that its root folder has, and name the others on stderr.

    resize: train on the full photos of images/, made smaller here, where others take the data set's own smaller JPEGs.
    UserError if the root has none of them.
    """
    missing = [name for name in DATASETS[group] if not (root / name).is_dir()]
    if len(missing) == len(DATASETS[group]):
        wrong = f"{root} has none of the scenes of {group}" if root.is_dir() else f"no such folder: {root}"
        raise UserError(f"{wrong}; pass the folder that has {', '.join(DATASETS[group])}")
    if missing:
        print(f"not found in {root}, left out: {', '.join(missing)}", file=sys.stderr)
    root = root.resolve()
    chosen = {name: ("-r", words[1][-1]) if resize and words else words for name, words in DATASETS[group].items()}
    return [SceneEntry(name, group, root / name, options) for name, options in chosen.items() if name not in missing]


def folder_scenes(folders: Sequence[Path]) -> list[SceneEntry]:
    """Make a scene of each folder, with the folder's name. UserError for a missing folder.

    Blender scenes (transforms_train.json, no sparse/) get `-w`, because their photos have no background and published
    scores are over white.
    """
    scenes = []
    for folder in folders:
        path = folder.resolve()
        if not path.is_dir():
            raise UserError(f"no such scene folder: {folder}; --scenes takes COLMAP, Blender or nerfstudio folders")
        blender = not (path / "sparse").exists() and (path / "transforms_train.json").exists()
        scenes.append(SceneEntry(path.name, FOLDERS, path, ("-w",) if blender else ()))
    return scenes


def finished_scenes(output: Path) -> list[SceneEntry]:
    """List the scenes of DATASETS with a model folder in `output`, which can be scored without the data sets."""
    return [
        SceneEntry(name, group, None, options)
        for group, scenes in DATASETS.items()
        for name, options in scenes.items()
        if (output / name).is_dir()
    ]


def check_names(scenes: Sequence[SceneEntry]) -> None:
    """Raise UserError if two scenes would share a model folder, or one would use the report's."""
    names = [scene.name for scene in scenes]
    if twice := [name for name in names if names.count(name) > 1]:
        raise UserError(f"two scenes are named {twice[0]}, and model folders are named after scenes; rename one")
    if taken := RESERVED.intersection(names):
        raise UserError(f"a scene cannot be named {min(taken)}: the report uses that folder; rename the scene's")


@dataclass(frozen=True)
class Run:
    """One training.

    options: words for train.py, without folders and --quiet. added: those of them that the data set's table lacks.
    """

    scene: SceneEntry
    config: str | None
    seed: int | None
    model: Path
    options: tuple[str, ...]
    added: tuple[str, ...]

    @property
    def title(self) -> str:
        """Scene, option set and seed, for messages."""
        seed = None if self.seed is None else f"seed {self.seed}"
        return ", ".join(part for part in (self.scene.name, self.config, seed) if part)

    @property
    def key(self) -> dict[str, object]:
        """Scene folder and train.py's options; a finished training stays valid while they are the same."""
        return {"options": list(self.options), "scene": self.scene.source and str(self.scene.source)}

    @property
    def iterations(self) -> int | None:
        """The last iteration, from the options; None if the training decides it, or train.py will refuse them."""
        parser = argparse.ArgumentParser(add_help=False, exit_on_error=False)
        parser.add_argument("--iterations", type=int, default=_DEFAULT_ITERATIONS)
        for name in ENDING:
            parser.add_argument(f"--{name}", default="0")
        try:
            values = vars(parser.parse_known_args(list(self.options))[0])
        except argparse.ArgumentError:
            return None
        # Zeros alone, as in 0.0, mean that the option is off.
        return None if any(values[name].strip("0.") for name in ENDING) else values["iterations"]


def describe_photos(options: Sequence[str]) -> str:
    """Describe the photos that train.py's options choose, and the factor by which these are made smaller."""
    chosen = _find_photo_options(options)
    return chosen.images if chosen.resolution == "-1" else f"{chosen.images}, resized by -r {chosen.resolution}"


def _find_photo_options(words: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("-i", "--images", default="images")
    parser.add_argument("-r", "--resolution", default="-1")
    return parser.parse_known_args(list(words))[0]


def check_photos(runs: Sequence[Run]) -> None:
    """Raise UserError if a scene of Mip-NeRF 360 lacks the folder of its smaller photos."""
    for run in runs:
        images = _find_photo_options(run.options).images
        if run.scene.options[:1] == ("-i",) and not (run.scene.source / images).is_dir():
            raise UserError(
                f"{run.scene.source} has no folder {images}; give --resize, which makes photos of images smaller, or "
                "get the data set with its smaller photos"
            )


class Record:
    """full_eval.py's record of a model folder: `key` (Run.key, None if others made the model) and finished stages."""

    def __init__(self, model: Path) -> None:
        """Read the record of a model folder, if it has one; a damaged record counts as none, with a warning."""
        self._path = model / RECORD
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

    def forget(self, name: str) -> None:
        """Let a stage be repeated."""
        self._content.get("stages", {}).pop(name, None)

    def _write(self) -> None:
        write_json(self._path, self._content)


def plan_runs(
    scenes: Sequence[SceneEntry],
    output: Path,
    common: Sequence[str],
    configs: Mapping[str, Sequence[str]],
    seeds: Sequence[int],
) -> list[Run]:
    """Plan a run for every scene, option set and seed. Empty `configs` or `seeds` mean one run without their folder.

    common: words for train.py in all runs. Model folders: output/<scene>[/<config>][/seed_N].
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
    """Raise UserError if a model folder would lie in a scene folder, where nothing must be written."""
    sources = {run.scene.source.resolve() for run in runs if run.scene.source}
    for run in runs:
        for source in sources:
            if run.model.is_relative_to(source):
                raise UserError(
                    f"the model folder {run.model} would lie in the scene folder {source}; choose another --output_path"
                )


def check_nesting(runs: Sequence[Run], output: Path) -> None:
    """Raise UserError if a model folder would lie in another one of an earlier call, or around one.

    That happens when one call has option sets or seeds and another one in the same output folder has none.
    """
    for run in runs:
        around = [parent for parent in run.model.parents if parent.is_relative_to(output) and parent != output]
        inside = [path.parent for depth in ("*", "*/*") for path in run.model.glob(f"{depth}/{RECORD}")]
        if there := [folder for folder in around if is_model(folder)] + inside:
            raise UserError(
                f"the model folder {run.model} and that of an earlier call, {there[0]}, would be nested; give "
                "the same --seeds and --configs, or none, as that call, or choose another --output_path"
            )


def is_model(folder: Path) -> bool:
    """Tell if a folder holds a model, or one that full_eval.py has begun."""
    return (folder / RECORD).is_file() or (folder / "point_cloud").is_dir()


def check_folders(runs: Sequence[Run]) -> None:
    """Raise UserError if a model folder has another training, which must not be overwritten or mixed."""
    for run in runs:
        record = Record(run.model)
        if record.key is None:
            if (run.model / "point_cloud").exists() or list(run.model.glob("chkpnt*.pth")):
                raise UserError(
                    f"{run.model} holds a model that full_eval.py has not trained; score it with --skip_training, or "
                    "choose another --output_path"
                )
        elif record.key != run.key:
            raise UserError(
                f"{run.model} was trained with other options or data ({_describe_differences(record.key, run.key)}); "
                "give the option set another name, choose another --output_path, or remove that folder"
            )


def _describe_differences(there: dict, asked: dict) -> str:
    """Return a text on how the scene or the options of an existing model differ from those asked for."""
    if there.get("scene") != asked["scene"]:
        return f"scene {there.get('scene')}, asked for {asked['scene']}"
    return f"{' '.join(map(str, there.get('options', [])))}; asked for {' '.join(asked['options'])}"
