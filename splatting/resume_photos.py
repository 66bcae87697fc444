"""New photos: photos that the cameras.json of a checkpoint's folder does not list. They train more often at first."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from groundwork.files.json_files import read_json
from groundwork.host.listing import some
from scene.cameras import Camera, camera_to_JSON
from scene.readers.holdout import EVERY
from scene.readers.info import HOLD
from splatting.folder import lies_in
from splatting.iteration import ViewOrder
from utils.system_utils import UserError

_CLOSE = 1e-4  # of the extent, and of a rotation's entries: poses that were written and read again differ by less


class NewFirst(ViewOrder):
    """An order of views in which every second iteration after `since`, up to `until`, trains on a photo of `names`.

    Checkpoints record the new photos, so that a resumed training has the same order.
    """

    def __init__(self, every: ViewOrder, since: int, until: int, names: list[str]) -> None:
        """Divide the views into new and old ones, which take turns in the span.

        every: order of all training views, which counts outside of the span.
        since: last iteration before the span.
        until: last iteration of the span.
        names: image names of the new photos.
        """
        super().__init__(every.cameras, every.seed)
        new = {*names}
        sides = [[view for view in every.cameras if (view.image_name in new) is side] for side in (True, False)]
        self._turns = [ViewOrder(views, every.seed) for views in sides] if all(sides) else []
        self._span = range(since + 1, until + 1)

    def __getitem__(self, iteration: int) -> Camera:
        if not self._turns or iteration not in self._span:
            return super().__getitem__(iteration)
        turn, old = divmod(iteration - self._span.start, 2)
        return self._turns[old][turn + 1]


def order_views(run: Any, record: Any) -> None:
    """Let new photos train more often, or those that were new in an earlier run.

    record: record of the checkpoint, or None.
    """
    if added := new_photos(run):
        count, until = len(added["names"]), added["until"]
        print(f"{count} photos are new; until iteration {until} every second one trains on one of them")
        run.has_new_photos = True
    run.added_photos = added or record
    if run.added_photos is not None:
        run.views = restore_order(run.views, run.added_photos)


def restore_order(every: ViewOrder, record: Any) -> ViewOrder:
    """Return the order of views by the record of a checkpoint. UserError if the record is broken."""
    try:
        return NewFirst(every, **record)
    except TypeError as error:
        raise UserError("the checkpoint's record of added photos is damaged; give another checkpoint") from error


def new_photos(run: Any) -> dict[str, Any] | None:
    """Return the record of photos that the checkpoint's folder does not list; None if it lists all photos, or none.

    UserError if other photos have moved, if photos that have trained would be held out now, and if the run writes into
    the checkpoint's own folder, whose list says which photos its checkpoints have seen.
    """
    if not run.start or not (before := _poses_in(Path(run.start).parent)):
        return None
    info, source = run.scene.info, run.dataset.source_path
    now = {view.image_name: _read_pose(camera_to_JSON(0, view)) for view in (*info.test_cameras, *info.train_cameras)}
    new, known = sorted(now.keys() - before.keys()), sorted(now.keys() & before.keys())
    if not new or not known:
        return None
    close = _CLOSE * np.array([[run.scene.cameras_extent], [1], [1], [1]])
    if moved := [name for name in known if (np.abs(now[name] - before[name]) > close).any()]:
        raise UserError(
            f"photos of {source} have other poses than when {run.start} was trained ({some(moved)}); register new "
            "photos in its COLMAP model with all others fixed, or train from the start"
        )
    _refuse_held_out(run, [view.image_name for view in info.test_cameras], len(now), [*before])
    if lies_in(run.start, run.dataset.model_path):
        raise UserError(
            f"{source} has photos that {run.start} was not trained on; give --start_checkpoint {run.start} and name "
            "another folder by -m, as this one keeps the model without them"
        )
    return {"since": run.first_iteration, "until": _find_end(run, new), "names": new}


def _poses_in(folder: Path) -> dict[str, np.ndarray]:
    """Read the poses of cameras.json by name, in its order; none if the file is missing or of another form."""
    try:
        return {view["img_name"]: _read_pose(view) for view in read_json(folder / "cameras.json")}
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return {}


def _read_pose(record: dict[str, Any]) -> np.ndarray:
    """Return position and rotation (4, 3)."""
    return np.array([record["position"], *record["rotation"]], float).reshape(4, 3)


def _refuse_held_out(run: Any, tests: list[str], count: int, before: list[str]) -> None:
    """Raise UserError if test views were trained on. New names shift the count of every HOLD-th photo."""
    if tests and run.options.holdout != EVERY:
        raise UserError(
            f"with more photos, --holdout {run.options.holdout} would hold out some that {run.start} was trained on; "
            "start a new training"
        )
    trained = {*before[math.ceil(len(before) / HOLD) :]}.intersection(tests)  # cameras.json lists test views first
    if trained and len(tests) == math.ceil(count / HOLD):  # else the scene says which views test
        raise UserError(
            f"--eval would hold out photos that {run.start} was trained on ({some(sorted(trained))}); leave --eval "
            "out, or give the new photos names that come after the others"
        )


def _find_end(run: Any, names: list[str]) -> int:
    """Return the iteration by which new photos have trained as often as the others, at most halfway to the end."""
    since, last, views = run.first_iteration, run.schedule.ends, run.views.cameras
    new = sum(view.image_name in names for view in views)
    count = int(2 * new * (since / max(len(views) - new, 1)))
    return since + (count if last is None else min(count, (last - since) // 2))  # None: a clock decides it
