"""What has changed since a training: the model, or photos, which then show other views than those of their cameras.

Each usual change of a model is undone, and tried on the views. Where none explains them, what does not fit is told.
"""

import math
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from arguments import read_model_json
from gaussian_renderer.scored_views import ScoredViews
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.gaussians.attributes import Rows
from scene.readers.point_cloud import read_point_cloud
from scene.scene import Scene
from splatting.evaluation.model_folder import curve_of
from splatting.evaluation.training_log import NAME as LOG
from splatting.evaluation.training_log import read_log
from splatting.findings import Finding
from splatting.host.listing import some
from splatting.registry import tools
from utils.image_utils import as_float, pixels_that_count, psnr
from utils.system_utils import UserError

MOST_PHOTOS = 300  # that are compared with each other
FITS = 18.0  # dB of training views; models that converge reach 22 and more
CLEARLY = 3.0  # dB that undoing a change has to gain, unless it comes to what was recorded
_SUSPECTS = 12  # views whose photos are looked for among all, those that fit worst
NEAR = 1.5  # dB between the record and a score of small renders
LOST = 6.0  # dB below the record, from which on something has changed
_SCALES = (1000.0, 100.0, 10.0, 0.1, 0.01, 0.001)
_TRIED = 2  # views that changes are tried on


_Undo = Callable[[Rows], Rows]  # of raw rows


def of_scene(scene: Scene) -> GaussianModel:
    """The Gaussians of a model but those that a part of its training has put beside the scene."""
    gaussians, facts = scene.gaussians, read_model_json(scene.model_path)
    means = gaussians.get_xyz.detach()
    own = torch.ones(len(means), dtype=torch.bool, device=means.device)
    for backdrop in tools("backdrop"):
        if (found := backdrop(facts, means)) is not None:
            own &= ~found
    return gaussians if own.all() or not own.any() else gaussians.part(own, gaussians.max_sh_degree)


def recorded_psnr(model: Path, iteration: int) -> float | None:
    """PSNR of training views that training recorded at an iteration, in its curve or log; None if in neither."""
    try:
        rows = [*curve_of(model), *read_log(model / LOG)]
    except UserError:
        return None
    found = (row.get("train_psnr") for row in rows if row["iteration"] == iteration)
    return next((score for score in found if score is not None), None)


def what_changed(
    scene: Scene, views: list[Camera], scored: ScoredViews, now: float, then: float | None
) -> Finding | None:
    """The change that explains why views have the PSNR `now`; None if none of the usual ones does.

    then: their PSNR in training, None if it is not known.
    """
    least = FITS if then is None else min(FITS, then - NEAR)
    few = views[:: -(-len(views) // _TRIED) or 1]
    tried = {pair: _score(few, _with(scene.gaussians, pair[1]), scored) for pair in _changes(scene)}
    change, undo = max(tried, key=lambda pair: tried[pair])
    best = _score(views, _with(scene.gaussians, undo), scored)
    explains = best >= now + CLEARLY and best >= least
    if explains or (then is not None and best >= max(then - NEAR, now + 1)):
        return change._replace(text=f"{change.text}: without that it is {best:.1f} dB")
    if strange := strange_photos(scene, scored):
        return strange
    if then is None or now > then - LOST:
        return None
    remedy = "restore the model and the photos of that training (its scene is in cfg_args), or train again"
    return Finding(f"it was {then:.1f} dB in training, so the model or the photos are not those of then", remedy)


def _with(gaussians: GaussianModel, undo: _Undo) -> GaussianModel:
    changed = gaussians.part(slice(None), gaussians.max_sh_degree)
    changed.set_rows(undo(dict(changed.rows())))
    return changed


@torch.no_grad()
def _score(views: list[Camera], gaussians: GaussianModel, scored: ScoredViews) -> float:
    """Mean PSNR of views."""
    values = []
    for view in views:
        image, target, mask = scored.compared(view, gaussians)
        if mask is None or mask.any():
            values.append(min(float(psnr(*(pixels_that_count(x, mask) for x in (image, as_float(target)))).mean()), 99))
    return sum(values) / max(len(values), 1)


def _changes(scene: Scene) -> Iterator[tuple[Finding, _Undo]]:
    rows, folder = scene.gaussians.rows(), scene.model_path
    yield (
        Finding("the quaternions begin with x", "write them as w x y z"),
        lambda rows: rows | {"rotation": rows["rotation"].roll(1, dims=1)},
    )
    if bool(((rows["opacity"] >= 0) & (rows["opacity"] <= 1)).all()):
        yield (
            Finding("the opacities are not logits", "write logits, as train.py does"),
            lambda rows: rows | {"opacity": rows["opacity"].clamp(1e-6, 1 - 1e-6).logit()},
        )
    if bool((rows["scaling"] > 0).all()):
        yield (
            Finding("the scales are no logarithms", "write natural logarithms, as train.py does"),
            lambda rows: rows | {"scaling": rows["scaling"].log()},
        )
    for factor in (factors := _factors(rows["xyz"], Path(folder))):
        remedy = f"scale it by {1 / factor:.3g}, or the scene as the model was"
        yield Finding(f"the model was scaled by {factor:.3g}", remedy), partial(_rescaled, factor, True)
    for factor in factors:
        text = f"the positions were scaled by {factor:.3g}, but not the sizes"
        yield Finding(text, f"scale the positions by {1 / factor:.3g}"), partial(_rescaled, factor, False)


def _factors(means: Tensor, folder: Path) -> list[float]:
    """Factors by which a model may have been scaled: powers of ten, and that to the points it began with."""
    try:
        start = torch.from_numpy(read_point_cloud(folder / "input.ply").points).to(means)
    except UserError:
        return list(_SCALES)
    spreads = [float((x - x.median(dim=0).values).norm(dim=1).median()) for x in (means, start)]
    return [*_SCALES, spreads[0] / spreads[1]] if min(spreads) > 0 else list(_SCALES)


def _rescaled(factor: float, sizes: bool, rows: Rows) -> Rows:
    scaling = rows["scaling"] - (math.log(factor) if sizes else 0.0)
    return rows | {"xyz": rows["xyz"] / factor, "scaling": scaling}


@torch.no_grad()
def strange_photos(scene: Scene, scored: ScoredViews) -> Finding | None:
    """Whether photos show other views than those of their cameras.

    Such a view fits another photo clearly better than its own, and its own photo fits another view clearly better.
    """
    views = [view for view in scene.getTrainCameras() if view.columns is None]
    size = views and (views[0].image_height, views[0].image_width)
    views = [view for view in views if (view.image_height, view.image_width) == size]
    views = views[:: -(-len(views) // MOST_PHOTOS) or 1]
    images = [scored.image(view, scene.gaussians) for view in views]
    photos = [as_float(scored.target(view)) for view in views]
    own = [_psnr(*pair) for pair in zip(images, photos, strict=True)]
    found = []
    for place in sorted(range(len(views)), key=own.__getitem__)[:_SUSPECTS]:
        row = [_psnr(images[place], photo) for photo in photos]
        if max(row) < max(FITS, own[place] + CLEARLY):
            continue
        if max(_psnr(image, photos[place]) for image in images) >= own[place] + CLEARLY:
            found.append(views[place].image_name)
    if not found:
        return None
    count = f"at least {len(found)} of {len(views)} photos"
    text = f"cameras and photos do not fit together: {count} show another view ({some(sorted(found))})"
    return Finding(text, "restore the photos that these cameras were computed from, under their names")


def _psnr(image: Tensor, photo: Tensor) -> float:
    return float(psnr(image, photo).mean())
