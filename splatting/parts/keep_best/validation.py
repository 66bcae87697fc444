"""Views that neither train nor test, but choose a model."""

from dataclasses import replace

from scene.readers.info import SceneInfo, held_out
from utils.system_utils import UserError

EVERY = 16  # every 16th training view by order does not train, and at least two do not
FEWEST = 8  # training views to take these from


def without_validation(info: SceneInfo) -> SceneInfo:
    """The dataset with fewer training views; those that were taken away are its validation views."""
    views = info.train_cameras
    if len(views) < FEWEST:
        raise UserError(
            f"--keep_best needs at least {FEWEST} training photos, and there are {len(views)}; leave it out"
        )
    step = min(EVERY, len(views) // 2)
    chosen = range(step // 2, len(views), step)
    left = [view for index, view in enumerate(views) if index not in chosen]
    held = held_out([replace(views[n], depth=None, depth_path="") for n in chosen])
    return info._replace(train_cameras=left, validation_cameras=held)
