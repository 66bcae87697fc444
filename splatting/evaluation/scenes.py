"""The scenes of an evaluation: the method's three data sets with their options, or any folders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

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


@dataclass(frozen=True)
class SceneEntry:
    """A scene: `source` is its folder, None if only a finished model is scored; `options` are words for train.py."""

    name: str
    group: str
    source: Path | None
    options: tuple[str, ...] = ()


def dataset_scenes(group: str, root: Path) -> list[SceneEntry]:
    """List the scenes of one of DATASETS under its root folder, including missing ones, whose run will fail.

    UserError if the root has none of them.
    """
    if not any((root / name).is_dir() for name in DATASETS[group]):
        wrong = f"{root} has none of the scenes of {group}" if root.is_dir() else f"no such folder: {root}"
        raise UserError(f"{wrong}; pass the folder that has {', '.join(DATASETS[group])}")
    root = root.resolve()
    return [SceneEntry(name, group, root / name, options) for name, options in DATASETS[group].items()]


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
    seen = set()
    for scene in scenes:
        if scene.name in seen:
            raise UserError(
                f"two scenes are named {scene.name}, but each model has its scene's name; rename one folder"
            )
        if scene.name in RESERVED:
            raise UserError(f"a scene cannot be named {scene.name}: the report uses that folder; rename the scene's")
        seen.add(scene.name)
