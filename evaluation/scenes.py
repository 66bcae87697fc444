"""The scenes of an evaluation: the method's three data sets with their options, or any folders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from utils.system_utils import UserError

_OUTDOOR = ("-i", "images_4")
_INDOOR = ("-i", "images_2")

# Pictures on which Kerbl et al. 2023 trained: Mip-NeRF 360 outdoors at a quarter, indoors at half the size.
DATASETS: dict[str, dict[str, tuple[str, ...]]] = {
    "mipnerf360": {
        **dict.fromkeys(("bicycle", "flowers", "garden", "stump", "treehill"), _OUTDOOR),
        **dict.fromkeys(("room", "counter", "kitchen", "bonsai"), _INDOOR),
    },
    "tanksandtemples": dict.fromkeys(("truck", "train"), ()),
    "deepblending": dict.fromkeys(("drjohnson", "playroom"), ()),
}
FOLDERS = "scenes"  # group of what --scenes names
RESERVED = {"figures"}  # of the report, beside the models


@dataclass(frozen=True)
class SceneEntry:
    """A scene: `source` is its folder, None where only a finished model is looked at; `options` are train.py's."""

    name: str
    group: str
    source: Path | None
    options: tuple[str, ...] = ()


def dataset_scenes(group: str, root: Path) -> list[SceneEntry]:
    """The scenes of one of DATASETS under its root folder, there or not: one that is missing fails by itself."""
    root = root.resolve()
    return [SceneEntry(name, group, root / name, options) for name, options in DATASETS[group].items()]


def folder_scenes(folders: Sequence[Path]) -> list[SceneEntry]:
    """A scene for each folder, named like it. Blender scenes (transforms_train.json, no sparse/) get `-w`: their
    pictures have no background of their own, and published scores are over white. UserError for a missing folder."""
    scenes = []
    for folder in folders:
        path = folder.resolve()
        if not path.is_dir():
            raise UserError(f"no such scene folder: {folder}; --scenes takes COLMAP or Blender folders")
        blender = not (path / "sparse").exists() and (path / "transforms_train.json").exists()
        scenes.append(SceneEntry(path.name, FOLDERS, path, ("-w",) if blender else ()))
    return scenes


def finished_scenes(output: Path) -> list[SceneEntry]:
    """The scenes of DATASETS that have a model folder in `output`: what there is to score without any data set."""
    return [
        SceneEntry(name, group, None, options)
        for group, scenes in DATASETS.items()
        for name, options in scenes.items()
        if (output / name).is_dir()
    ]


def check_names(scenes: Sequence[SceneEntry]) -> None:
    """UserError where two scenes would share a model folder, or one would take the report's."""
    seen = set()
    for scene in scenes:
        if scene.name in seen:
            raise UserError(f"two scenes are named {scene.name}, and models go by the name; rename one folder")
        if scene.name in RESERVED:
            raise UserError(f"a scene cannot be named {scene.name}: the report's files lie there; rename its folder")
        seen.add(scene.name)
