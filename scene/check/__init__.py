"""Judgement of a scene's photos, cameras and points before a training, for train.py, doctor.py and --advise alike."""

import argparse
import os
import sys

from scene.check.cameras import of_cameras
from scene.check.duplicates import of_duplicates
from scene.check.findings import Finding
from scene.check.photos import of_damage, of_photos
from scene.check.points import of_points
from scene.readers.info import SceneInfo, as_camera_info
from utils.system_utils import UserError

__all__ = ["Finding", "findings", "of_options", "tell"]
LOOKED_AT = 16  # photos that are decoded, small
_LINES = 5  # most findings that a training prints


def findings(info: SceneInfo, most: int = LOOKED_AT, halves: bool = False, alpha: bool = True) -> list[Finding]:
    """Faults of the records that readers return, the severe ones first; none if nothing is wrong.

    most: photos that are decoded. halves: test views train, too, with their left halves.
    alpha: that of photos counts (--mask_meaning).
    """
    train, test = ([*map(as_camera_info, views)] for views in (info.train_cameras, info.test_cameras))
    info = info._replace(train_cameras=train, test_cameras=test)
    of_files = *of_photos(info, most, alpha), *of_damage(info, most), *of_duplicates(info, halves)
    found = [*of_cameras(info), *of_files, *of_points(info)]
    return sorted(found, key=lambda one: not one.severe)


def of_options(info: SceneInfo, options: argparse.Namespace, halves: bool) -> list[Finding]:
    """`findings` with the model options of a training; code written for the reference lacks those that we added."""
    alpha = getattr(options, "mask_meaning", "") != "none"
    return findings(info, halves=halves, alpha=alpha)


def tell(found: list[Finding], source: str | os.PathLike, quiet: bool = False) -> None:
    """Raise the first severe finding as a UserError; print the others as a few warnings. quiet: print none."""
    if found and found[0].severe:
        raise UserError(str(found[0]))
    if quiet:
        return
    for one in found[:_LINES]:
        print(f"warning: {one}", file=sys.stderr)
    if len(found) > _LINES:
        print(f"{len(found) - _LINES} more: python doctor.py -s {source}", file=sys.stderr)
