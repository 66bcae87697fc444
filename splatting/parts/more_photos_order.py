"""Which photos a checkpoint has not trained on, by the cameras.json of its folder, and the order of views with them."""

import math
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scene.cameras import Camera
from scene.readers.holdout import EVERY
from scene.readers.info import HOLD
from splatting.files.json_files import read_json
from splatting.host.listing import some
from splatting.training.iteration import ViewOrder
from utils.camera_utils import camera_to_JSON
from utils.system_utils import UserError

_CLOSE = 1e-4  # of the extent, and of a rotation's entries: poses that were written and read again differ by less


def new_photos(run: Any) -> list[str]:
    """Names of views that the folder of the checkpoint does not list, sorted; none if it lists none of this scene.

    UserError for others that have moved, and for trained ones that would be held out now.
    """
    if not run.start or not (before := _views_of(Path(run.start).parent)):
        return []
    info = run.scene.info
    views = {view.image_name: view for view in (*info.test_cameras, *info.train_cameras)}
    new, known = sorted(views.keys() - before.keys()), sorted(views.keys() & before.keys())
    if not new or not known:
        return []
    moved = [name for name in known if _has_moved(views[name], before[name], run.scene.cameras_extent)]
    if moved:
        raise UserError(
            f"photos of {run.dataset.source_path} have other poses than when {run.start} was trained ({some(moved)}); "
            "register new photos in its COLMAP model with all others fixed, or train from the start"
        )
    _refuse_held_out(run, before)
    return new


def _views_of(folder: Path) -> dict[str, dict]:
    """Entries of cameras.json by name, in its order; none if there is no such file, or it is of another form."""
    try:
        return {view["img_name"]: view for view in read_json(folder / "cameras.json")}
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return {}


def _has_moved(view: Any, before: dict, extent: float) -> bool:
    now = camera_to_JSON(0, view)
    try:
        far = np.linalg.norm(np.subtract(now["position"], before["position"])) > _CLOSE * extent
        return bool(far or np.abs(np.subtract(now["rotation"], before["rotation"])).max() > _CLOSE)
    except (KeyError, TypeError, ValueError):
        return False  # a file of another program


def _refuse_held_out(run: Any, before: dict[str, dict]) -> None:
    """UserError if test views were trained on. With every HOLD-th held out, new names move the count."""
    tests, trains = run.scene.info.test_cameras, run.scene.info.train_cameras
    if tests and run.options.holdout != EVERY:
        raise UserError(
            f"with more photos, --holdout {run.options.holdout} would hold out some that {run.start} was trained on; "
            "start a new training"
        )
    if not tests or len(tests) != math.ceil(len([*tests, *trains]) / HOLD):  # the scene says which views test
        return
    held = [view.image_name for view in tests if view.image_name in before]
    tested = {*list(before)[: math.ceil(len(before) / HOLD)]}  # cameras.json lists them first
    if trained := [name for name in held if name not in tested]:
        raise UserError(
            f"--eval would hold out photos that {run.start} was trained on ({some(trained)}); leave --eval out, or "
            "give the new photos names that come after the others"
        )


class Added(NamedTuple):
    """Photos that a training got after an iteration, `since`, and until when they train more often."""

    since: int
    until: int
    names: list[str]

    @classmethod
    def at(cls, since: int, last: int | None, names: Collection[str], views: Sequence[Camera]) -> "Added":
        """Until the new ones have trained as often as the others on average, at most half of what is left to `last`.

        last: None where a clock decides it. views: all that train.
        """
        new = sum(view.image_name in names for view in views)
        visits = since / max(len(views) - new, 1)
        count = int(2 * new * visits)
        return cls(since, since + (count if last is None else min(count, (last - since) // 2)), sorted(names))

    @classmethod
    def restored(cls, state: Any) -> "Added":
        """From a checkpoint. UserError if it is broken."""
        try:
            found = cls(**state)
            valid = type(found.since) is type(found.until) is int and all(isinstance(name, str) for name in found.names)
        except TypeError:
            valid = False
        if not valid:
            raise UserError("the checkpoint's record of added photos is damaged; give another checkpoint")
        return found


class _NewFirst(ViewOrder):
    """Every second iteration of a span trains on a new view, and the others on an old one; then all by epochs."""

    def __init__(self, every: ViewOrder, added: Added) -> None:
        super().__init__(every.cameras, every.seed)
        names = {*added.names}
        self._new, self._old = (
            ViewOrder([view for view in every.cameras if (view.image_name in names) is new], every.seed)
            for new in (True, False)
        )
        self._added = added

    def __getitem__(self, iteration: int) -> Camera:
        since, until, _ = self._added
        if not since < iteration <= until:
            return super().__getitem__(iteration)
        turn, old = divmod(iteration - since - 1, 2)
        return (self._old if old else self._new)[turn + 1]

    def coming(self, iteration: int, count: int) -> list[Camera]:
        return list(dict.fromkeys(super().coming(iteration, count)))  # few new ones come again soon


def added_order(every: ViewOrder, added: Added) -> ViewOrder:
    """The order with the new views, if both new and old ones train."""
    names = {*added.names}
    new = sum(view.image_name in names for view in every.cameras)
    return _NewFirst(every, added) if 0 < new < len(every.cameras) else every
