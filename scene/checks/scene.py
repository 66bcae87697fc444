"""All checks of a scene, before a training and for doctor.py, causes before their effects."""

import argparse
import contextlib
import io
import os
import sys
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

from groundwork.finding import Finding, Severity, from_error, note
from scene.checks.cameras import check_cameras, check_extent, check_lens_shapes, check_lenses
from scene.checks.conversion import check_conversion, describe_changed_photos, describe_left_out
from scene.checks.fit import check_agreement, check_geometry
from scene.checks.photo_files import check_blur, check_duplicates
from scene.checks.photos import LOOKED_AT, SHARED_TEXT, check_photos, check_size, check_views
from scene.checks.points import check_cloud, check_points
from scene.dataset_readers import SceneInfo, read_scene
from scene.images.masks import NO_MASKS, MaskOptions
from scene.readers.info import NEAREST, as_camera_info
from scene.scene import Scene
from utils.system_utils import UserError

MOST_PHOTOS = 100  # that the doctor decodes, small
_LINES = 5  # most findings that a training prints


def findings(
    info: SceneInfo, options: argparse.Namespace | None = None, halves: bool = False, most: int = LOOKED_AT
) -> list[Finding]:
    """Find faults of the records that readers return, the worst first.

    options: the model options of a training; code written for the reference lacks those that we added. halves: test
    views train, too, with their left halves. most: photos that are decoded.
    """
    alpha = getattr(options, "mask_meaning", "") != "none"
    train, test = ([*map(as_camera_info, views)] for views in (info.train_cameras, info.test_cameras))
    info = info._replace(train_cameras=train, test_cameras=test)
    views = sorted((*train, *test), key=lambda view: str(view.image_name))  # the same ones whatever is held out
    place = Path(getattr(options, "source_path", ""), getattr(options, "images", "images")).absolute()
    photos = [*check_photos(views, most, alpha, *[str(place)] * place.is_dir()), *check_duplicates(info, halves)]
    found = [*check_cameras(info), *photos, *([] if has_shared_pixels(photos) else check_points(info))]
    return sorted(found, key=lambda one: -one.severity)


def has_shared_pixels(found: Sequence[Finding]) -> bool:
    """Return True if findings name pixels that all photos share: these may spoil poses and points."""
    return any(SHARED_TEXT in one.text for one in found)


def report(found: list[Finding], source: str | os.PathLike, quiet: bool = False) -> None:
    """Raise the first finding as a UserError if it is hopeless; print a few as warnings. quiet: print none."""
    if found and found[0].severity == Severity.HOPELESS:
        raise UserError(str(found[0]))
    if quiet:
        return
    for one in found[:_LINES]:
        print(f"warning: {one}", file=sys.stderr)
    if len(found) > _LINES:
        print(f"{len(found) - _LINES} more: python doctor.py -s {source}", file=sys.stderr)


def check_scene(scene: Scene, options: argparse.Namespace, resumed: bool) -> None:
    """Check a scene before a training: raise a UserError if it cannot be trained, and print warnings of its faults.

    Messages also tell of photos left out or changed since the conversion, and of an offset or a factor between the
    scene's coordinates and those of the training.

    options: the model options. resumed: faults are not looked for again, as the start has warned of them.
    """
    info, views = scene.info, scene.getTrainCameras()
    for text in filter(None, (describe_left_out(options.source_path), describe_changed_photos(options.source_path))):
        print(text)
    if not resumed:
        smallest = min((view.image_width, view.image_height) for view in views)
        found = [*findings(info, options, scene.halves), *check_size(smallest)]
        report(found, options.source_path)
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


def check_dataset(source: str, images: str, masks: MaskOptions = NO_MASKS) -> list[Finding]:
    """Collect doctor.py's findings on the scene in a folder. images: as train.py's -i."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            info = read_scene(source, images, hold_out=False, masks=masks, native=True)
    except UserError as error:
        return [*_collect_notes(said.getvalue()), from_error(error)]
    views = info.train_cameras
    checks = [check_views(views), check_lenses(source, views), check_extent(info), check_cloud(info)]
    found = findings(info, argparse.Namespace(source_path=source, images=images), most=MOST_PHOTOS)
    checks += [found, check_blur(info, MOST_PHOTOS)]
    if not any(check_lens_shapes(info)) and not has_shared_pixels(found):  # else poses have that cause
        checks += [check_geometry(source, info), check_agreement(Path(source) / "sparse" / "0")]
    return [*_collect_notes(said.getvalue()), *check_conversion(source), *chain(*checks)]


def _collect_notes(said: str) -> list[Finding]:
    """Turn the messages that readers printed, without progress bars, into notes."""
    texts = [text.strip() for text in said.replace("\r", "\n").splitlines() if text.strip() and "%|" not in text]
    return [note(text) for text in texts]
