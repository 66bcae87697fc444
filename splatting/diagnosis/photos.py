"""Photos that do not belong to their cameras: of another focal length, or of another view."""

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from gaussian_renderer.scored_views import ScoredViews
from scene.cameras import Camera
from scene.readers.info import CameraInfo
from scene.scene import Scene
from splatting.diagnosis import Line
from splatting.host.listing import some
from utils.image_utils import as_float, psnr

MOST_PHOTOS = 300  # that are compared with each other
FITS = 18.0  # dB of training views; models that converge reach 22 and more
CLEARLY = 3.0  # dB that undoing a change has to gain, unless it comes to what was recorded
_SUSPECTS = 12  # views whose photos are looked for among all, those that fit worst
_TRIED = 2  # views that focal lengths are tried on
_WIDEST, _STEP, _FINE = 2.5, 1.16, 1.03  # factors of focal lengths: the largest, between two, and between two at last
_NO_FACTOR = 1.08  # a smaller one is told by no image of 200 pixels
_INSIDE = 0.2  # of a photo that a changed focal length has to leave


@torch.no_grad()
def other_focal_length(scene: Scene, views: list[Camera], scored: ScoredViews, least: float) -> Line | None:
    """Line if views would fit with another focal length, to `least` dB at least.

    That of a pinhole scales its image around the principal point, so no view is rendered again.
    """
    infos = scene.info.train_cameras
    views = [view for view in views if infos[view.uid].native is None]
    views = views[:: -(-len(views) // _TRIED) or 1]
    pairs = [(scored.image(view, scene.gaussians), as_float(scored.target(view)), infos[view.uid]) for view in views]
    if not pairs:
        return None
    steps = range(-6, 7)
    factor = max((_STEP**step for step in steps if _STEP**step < _WIDEST), key=lambda one: _gain(pairs, one)[0])
    factor = max((factor * _FINE**step for step in steps[3:-3]), key=lambda one: _gain(pairs, one)[0])
    gain, score = _gain(pairs, factor)
    if gain < CLEARLY or score < least or 1 / _NO_FACTOR < factor < _NO_FACTOR:
        return None
    text = f"the cameras have {factor:.2g} times the focal length of these photos: without that it is {score:.1f} dB"
    return Line(text, "restore the cameras or the photos of the training, as other sizes or crops need other cameras")


def _gain(pairs: list[tuple[Tensor, Tensor, CameraInfo]], factor: float) -> tuple[float, float]:
    """What undoing a factor of the focal length gains (dB), and the PSNR with it, where both images show something."""
    before, after = [], []
    for image, photo, view in pairs:
        scaled, inside = _scaled(image, factor, 2 * view.cx / view.width - 1, 2 * view.cy / view.height - 1)
        if float(inside.float().mean()) < _INSIDE:
            return float("-inf"), 0.0
        before.append(float(psnr(image[:, inside], photo[:, inside]).mean()))
        after.append(float(psnr(scaled[:, inside], photo[:, inside]).mean()))
    before, after = (sum(values) / len(values) for values in (before, after))
    return after - before, after


def _scaled(image: Tensor, factor: float, across: float, down: float) -> tuple[Tensor, Tensor]:
    """An image (3, H, W) made smaller by a factor around a place, in [-1, 1]; and where it has pixels (H, W)."""
    y, x = ((torch.arange(side, device=image.device) * 2 + 1) / side - 1 for side in image.shape[1:])
    y, x = down + factor * (y - down), across + factor * (x - across)
    grid = torch.stack([x.expand(len(y), -1), y[:, None].expand(-1, len(x))], dim=-1)
    scaled = grid_sample(image[None], grid[None].to(image), padding_mode="border", align_corners=False)[0]
    return scaled, (grid.abs() <= 1).all(-1)


@torch.no_grad()
def strange_photos(scene: Scene, scored: ScoredViews) -> Line | None:
    """Line if photos show other views than those of their cameras.

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
    return Line(text, "restore the photos that these cameras were computed from, under their names")


def _psnr(image: Tensor, photo: Tensor) -> float:
    return float(psnr(image, photo).mean())
