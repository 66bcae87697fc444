"""Photos that are added to a converted scene, whose photos keep their poses and lenses.

The folder `base` has the database and the model of the conversion before, until the next one that adds photos.
"""

import shutil
import sys
from collections.abc import Sequence
from typing import Any

from applications.convert.colmap import copy_database, list_photos
from applications.convert.images import name_prepared
from applications.convert.layout import Layout, image_names
from applications.convert.report import read_survey, read_tried
from groundwork.files.image_files import PHOTO_SUFFIXES
from groundwork.host.listing import some
from utils.system_utils import UserError


def keep_base(layout: Layout, finished: bool, names: Sequence[str]) -> None:
    """Keep the database and the model that new photos are added to.

    finished: the last conversion was finished. One that was interrupted while it added photos keeps its base.
    names: of the photos in `input`.
    UserError if there is nothing to add to, or if some photos of the model are gone.
    """
    prepared = set(name_prepared(layout, names).values())
    if finished and not prepared <= set(image_names(layout.prepared)):
        new = layout.base.with_name(layout.base.name + ".new")
        shutil.rmtree(new, ignore_errors=True)
        new.mkdir()
        copy_database(layout.database, new / layout.database.name)
        largest = read_survey(layout, read_tried(layout))[0]
        shutil.copytree(layout.models / largest.folder, new / layout.base_model.name)
        shutil.rmtree(layout.base, ignore_errors=True)
        new.rename(layout.base)
    if not layout.base.is_dir():
        raise UserError(
            f"{layout.input} has no new photos; put them there"
            if finished
            else f"--add needs a scene that convert.py has finished, and {layout.scene} is none; leave --add out"
        )
    if gone := sorted(set(list_photos(layout.base_database)) - prepared):
        lacking = some([_strip_suffix(name) for name in gone])
        raise UserError(
            f"--add keeps the photos of the scene, and {layout.input} lacks {lacking}; put them back, or leave --add "
            "out to begin anew"
        )


def _strip_suffix(name: str) -> str:
    """Return a prepared photo's name without the suffix that `prepare_images` appended."""
    own = name.rpartition(".")[0]
    return own if own.lower().endswith(PHOTO_SUFFIXES) else name


def forget_base(layout: Layout) -> None:
    """Remove the base before a run that gives all photos new poses, and warn the user."""
    if layout.base.is_dir():
        print("warning: without --add, photos that were added before get new poses, as all do", file=sys.stderr)
        shutil.rmtree(layout.base)


def read_base_state(layout: Layout) -> list[Any]:
    """Read the names and the time of the base's database, on which the results of --add depend."""
    return [list_photos(layout.base_database), layout.base_database.stat().st_mtime_ns]


def describe_added(layout: Layout, left_out: Sequence[str]) -> str:
    """Say how many of the new photos were placed."""
    old = list_photos(layout.base_database)
    new = [name for name in image_names(layout.prepared) if name not in old]
    placed = len(set(new) - set(left_out))
    return f"added: {placed} of {len(new)} new photos; the {len(old)} before keep their poses"
