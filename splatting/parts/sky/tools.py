"""What tools know of a sky: whether a scene asks for one, and which Gaussians of a model are its."""

import argparse
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from scene.readers.tracks import Track
from scene.scene import Scene
from splatting.files.json_files import read_model_json
from splatting.parts.sky.directions import FEWEST
from splatting.parts.sky.shell import Shell, find_sky, said_of_sky
from utils.system_utils import UserError


def advise(scene: Scene, tracks: Sequence[Track | None]) -> Iterator[tuple[str, str]]:
    """Texts, and the options that they speak for, or none."""
    if len(scene.info.point_cloud.points):
        _, share = find_sky(scene, Shell.around(scene.info))
        yield said_of_sky(share), "--sky auto" if share >= FEWEST else ""


def beside(facts: dict[str, Any], means: Tensor) -> Tensor | None:
    """Which Gaussians are far away, large and opaque by intent, (N,) bool; None: there is no sky.

    facts: of model.json. means: (N, 3) in the model's frame.
    """
    state = facts.get("sky")
    return Shell.restored(state).rows(means) if state else None


def add_export_options(add: Callable[..., Any]) -> None:
    """Add options to those of export.py."""
    add("--no_sky", action="store_true", help="leave the sky of train.py --sky out (default: keep it)")


def left_out(args: argparse.Namespace, means: Tensor) -> Tensor | None:
    """Which Gaussians those options leave out, (N,) bool. UserError where that cannot be told."""
    if not args.no_sky:
        return None
    found = beside(read_model_json(Path(args.model_path)), means) if args.model_path else None
    if found is None:
        raise UserError("--no_sky needs a model folder (-m) that was trained with --sky auto; leave it out")
    return found
