"""Changes since a training: of the model, or of photos, which then show other views than those of their cameras."""

from pathlib import Path

import torch
from torch import Tensor

from gaussian_renderer.scored_views import ScoredViews
from groundwork.finding import Finding
from groundwork.host.listing import some
from scene.scene import Scene
from splatting.records.model_folder import curve_of
from splatting.records.training_log import NAME as LOG
from splatting.records.training_log import read_log
from utils.image_utils import as_float, psnr
from utils.system_utils import UserError

MOST_PHOTOS = 300  # that are compared with each other
FITS = 18.0  # dB of training views; models that converge reach 22 and more
CLEARLY = 3.0  # dB by which a view fits another photo better than its own
_SUSPECTS = 12  # views whose photos are looked for among all, those that fit worst
LOST = 6.0  # dB below the record, from which on something has changed


def read_recorded_psnr(model: Path, iteration: int) -> float | None:
    """PSNR of training views that training recorded at an iteration, in its curve or log; None if in neither."""
    try:
        rows = [*curve_of(model), *read_log(model / LOG)]
    except UserError:
        return None
    found = (row.get("train_psnr") for row in rows if row["iteration"] == iteration)
    return next((score for score in found if score is not None), None)


def find_changes(scene: Scene, scored: ScoredViews, now: float, then: float | None) -> Finding | None:
    """Return a text on the changes that explain the PSNR `now` of some views; None if no change is known.

    then: PSNR of the same views in training, None if it is not known.
    """
    if strange := check_strange_photos(scene, scored):
        return strange
    if then is None or now >= then - LOST:
        return None
    remedy = "restore the model and the photos of that training (its scene is in cfg_args), or train again"
    return Finding(f"it was {then:.1f} dB in training, so the model or the photos are not those of then", remedy)


@torch.no_grad()
def check_strange_photos(scene: Scene, scored: ScoredViews) -> Finding | None:
    """Find photos that show other views than those of their cameras.

    The view of such a camera fits another photo clearly better than its own, and its photo fits another view clearly
    better.
    """
    views = [view for view in scene.getTrainCameras() if view.columns is None]
    size = views and (views[0].image_height, views[0].image_width)
    views = [view for view in views if (view.image_height, view.image_width) == size]
    views = views[:: -(-len(views) // MOST_PHOTOS) or 1]
    images = [scored.image(view, scene.gaussians) for view in views]
    photos = [as_float(scored.target(view)) for view in views]
    own = [_measure_psnr(*pair) for pair in zip(images, photos, strict=True)]
    found = []
    for place in sorted(range(len(views)), key=own.__getitem__)[:_SUSPECTS]:
        row = [_measure_psnr(images[place], photo) for photo in photos]
        if max(row) < max(FITS, own[place] + CLEARLY):
            continue
        if max(_measure_psnr(image, photos[place]) for image in images) >= own[place] + CLEARLY:
            found.append(views[place].image_name)
    if not found:
        return None
    count = f"at least {len(found)} of {len(views)} photos"
    text = f"cameras and photos do not fit together: {count} show another view ({some(sorted(found))})"
    return Finding(text, "restore the photos that these cameras were computed from, under their names")


def _measure_psnr(image: Tensor, photo: Tensor) -> float:
    return float(psnr(image, photo).mean())
