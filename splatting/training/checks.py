"""Checks made before training, so that a hopeless one fails at once."""

import argparse
import sys

from scene.readers.info import NEAREST
from scene.scene import Scene
from splatting.findings.photos import already_undistorted, hints, left_out
from splatting.findings.scene import of_options, tell
from utils.system_utils import UserError


def check_scene(scene: Scene, options: argparse.Namespace, resumed: bool) -> None:
    """Refuse a scene that cannot be trained (UserError), warn of its faults, and say where its frame is another.

    A resumed training goes on with what its start was told of.
    """
    info, views = scene.info, scene.getTrainCameras()
    if text := left_out(options.source_path):
        print(text)
    if not resumed:
        smallest = min((view.image_width, view.image_height) for view in views)
        found = [*of_options(info, options, scene.halves), *hints(info, smallest, options.white_background)]
        tell(found, options.source_path)
    if info.offset.any():
        print(
            f"the scene's coordinates are large compared with its extent, so {tuple(info.offset.tolist())} is "
            "subtracted from them (world_offset in model.json); to write the model in the scene's own coordinates, use "
            "python -m scene.export_world"
        )
    if (factor := scene.gaussians.enlargement) != 1:
        print(
            f"much of the scene is nearer than {NEAREST} units, so depths from {NEAREST / factor:.2g} on are drawn; "
            "files keep the scene's unit"
        )


def check_lenses(options: argparse.Namespace) -> None:
    """Say where --lenses native, as it was given, comes too late."""
    if getattr(options, "lenses", "") == "native" and already_undistorted(options.source_path):
        print(
            "warning: --lenses native has no effect, since convert.py undistorted the photos of this scene; to train "
            "on them as they were taken, convert again with --lenses native",
            file=sys.stderr,
        )


def check_alone(projection: str, several: bool) -> None:
    """Refuse rays of a training of several processes (UserError)."""
    if several and projection == "ray":
        raise UserError(
            "--projection ray needs a training of one process; leave it out, or start train.py without torchrun"
        )
