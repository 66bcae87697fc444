"""Residuals for masks of what one photo shows and the others do not, such as passers-by (--robust_mask).

Masks follow from residuals alone; no network is asked. Robust masks from residuals: Sabour et al. 2023 (RobustNeRF),
section 4. Residuals kept over a training, and a level over all photos: Sabour et al. 2024 (SpotLessSplats), section 4.
Both papers take the size of each pixel's residual. Here residuals are averaged with their sign over cells: detail that
is not learnt yet cancels out in a cell, a passer-by does not. Cells beside an outlier have a second, lower limit
(hysteresis, as in Canny 1986, "A computational approach to edge detection"), because a cell at the edge of a passer-by
shows both.
"""

import math
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, ClassVar

import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d, interpolate, max_pool2d

from gaussian_renderer.scored_views import ScoredViews
from groundwork.files.image_files import dim_masked, to_bytes
from groundwork.host.listing import some
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.images.find import names_below
from scene.readers.info import places
from splatting.records.renders import MASK_PICTURE, WIDEST, WORST, sheet
from utils.image_utils import as_float
from utils.system_utils import UserError, atomic_write

CELLS = 32  # of a photo, across and down
_NEWEST = 0.5  # weight of the newest residuals in a photo's
_FACTOR = 13.0  # times the level of all photos is what detail and highlights rarely reach
_BESIDE = 3.0  # times that level suffice beside an outlier
_AROUND = 5  # cells across, most of which are outliers somewhere in a passer-by, but not in a highlight
# Of so many visits of a photo, the last trains all pixels: else a floater before its camera, which no other photo
# shows, would be masked for good. A passer-by that is learnt there is unlearnt by other photos.
_UNMASKED = 16
_STATE = ("residuals", "levels", "visits")
MASKED = 0.3  # of a photo, at most, where photos of passers-by are searched
MOST_PHOTOS = 300  # that are searched
CLEAR = 0.11  # mean difference of a passer-by; what is not learnt yet rarely differs so much
FEW = 0.2  # of the photos, which a bare wall or a sky may reach after a short training


class Residuals:
    """The residuals of all training photos so far, and the masks that follow from them.

    share: largest share of a photo that is masked.
    residuals: (n, CELLS, CELLS), by the cameras' uid.
    levels: (n,), the value that the largest `share` of a photo's residuals exceed, NaN before the first ones.
    least: visits of a photo until it is masked.
    early: visits after which limits are still twice as high, as not all is learnt yet.
    """

    least: ClassVar[int] = 2
    early: ClassVar[int] = 5

    def __init__(self, cameras: Sequence[Camera], share: float, device: torch.device) -> None:
        """Begin without any residual.

        cameras: training cameras.
        share: largest share of a photo that is masked, 0 to 1.
        """
        self.cameras = sorted(cameras, key=lambda camera: camera.uid)
        count = len(cameras)
        self._below = CELLS**2 - math.floor(share * CELLS**2)
        self.residuals = torch.zeros(count, CELLS, CELLS, device=device)
        self.levels = torch.full((count,), math.nan, device=device)
        self.visits = torch.zeros(count, dtype=torch.int64)
        self._next: tuple[int, Tensor] | None = None  # uid and residuals of a step that is not taken yet

    @torch.no_grad()
    def mask(self, camera: Camera, image: Tensor, target: Tensor, mask: Tensor | None, learns: bool) -> Tensor | None:
        """Return the pixels of a render that count, (1, H, W) bool, within a mask; None if all do.

        learns: true if the residuals of this step tell anything. `keep` keeps the residuals once the step is taken.
        """
        uid, self._next = camera.uid, None
        found = self.residuals[uid]
        if learns:
            newest = _average_cells(image, target, mask)
            found = torch.lerp(found, newest, _NEWEST) if self.visits[uid] else newest
            self._next = uid, found
        if self.visits[uid] < self.least or (learns and self.visits[uid] % _UNMASKED == _UNMASKED - 1):
            return mask
        counts = self._unmasked_pixels(uid, found, image.shape[-2:])
        return counts if mask is None else mask if counts is None else counts & mask

    def keep(self) -> None:
        """Keep the residuals of a step that is taken."""
        if self._next is not None:
            uid, found = self._next
            self.residuals[uid], self.levels[uid], self._next = found, self._find_level(found), None
            self.visits[uid] += 1

    def _find_level(self, residuals: Tensor) -> Tensor:
        return residuals.flatten().kthvalue(self._below).values

    def _outlier_limit(self, uid: int, factor: float) -> Tensor:
        return factor * (1 + self.early / int(self.visits[uid])) * self.levels.nanmedian()

    def _find_outliers(self, uid: int, residuals: Tensor) -> Tensor:
        """Return the cells far beyond the level of all photos, without small groups; the largest if there are many."""
        outliers = residuals > self._outlier_limit(uid, _FACTOR)
        around = {"kernel_size": _AROUND, "stride": 1, "padding": _AROUND // 2}
        most = avg_pool2d(outliers[None].float(), **around, count_include_pad=False) > 0.5
        near = max_pool2d((most & outliers).float(), **around)[0] > 0
        return outliers & near & (residuals > self._find_level(residuals))

    def _unmasked_pixels(self, uid: int, residuals: Tensor, size: Sequence[int]) -> Tensor | None:
        """Return all pixels but those of outliers and of cells beside outliers, (1, H, W) bool; None if all count."""
        beside = max_pool2d(self._find_outliers(uid, residuals)[None].float(), 3, stride=1, padding=1)[0] > 0
        masked = beside & (residuals > self._outlier_limit(uid, _BESIDE)) & (residuals > self._find_level(residuals))
        return interpolate(masked[None, None].float(), size=tuple(size))[0] == 0 if masked.any() else None

    def counted(self, camera: Camera) -> Tensor | None:
        """Return the pixels of a view that are not masked now, (1, H, W) bool; None: no mask, as in test views."""
        if camera not in self.cameras or self.visits[camera.uid] < self.least:
            return None
        return self._unmasked_pixels(camera.uid, self.residuals[camera.uid], (camera.image_height, camera.image_width))

    def difference(self, camera: Camera) -> float:
        """Return the mean residual of a view's outliers, in [0, 1]; 0 without any."""
        residuals = self.residuals[camera.uid]
        return float(residuals[self._find_outliers(camera.uid, residuals)].mean().nan_to_num())

    def captured(self) -> dict[str, Any]:
        """Return the state that a resumed training needs, as plain values."""
        state = {name: getattr(self, name).clone() for name in _STATE}
        return {"names": [camera.image_name for camera in self.cameras], **state}

    def restore(self, state: dict[str, Any]) -> None:
        """Take the state of `captured()`, in which photos may be missing. UserError for a state that does not fit."""
        names = [camera.image_name for camera in self.cameras]
        rows = places(state.get("names"), names) if isinstance(state, dict) else None
        shapes = {name: (len(rows or []), *getattr(self, name).shape[1:]) for name in _STATE}
        if not rows or any(getattr(state.get(name), "shape", None) != shape for name, shape in shapes.items()):
            raise UserError("the checkpoint has residuals of other photos; resume it with its own scene and options")
        for name in _STATE:
            mine = getattr(self, name)
            mine[rows] = state[name].to(mine)


@torch.no_grad()
def residuals_of(cameras: Sequence[Camera], views: ScoredViews, gaussians: GaussianModel) -> Residuals:
    """Return the residuals and masks of photos after a training that did not keep them."""
    masks = Residuals(cameras, MASKED, gaussians.get_xyz.device)
    masks.least, masks.early = 1, 0  # it is trained
    for camera in cameras:
        masks.mask(camera, *views.compared(camera, gaussians), learns=True)
        masks.keep()
    return masks


def odd_share(masks: Residuals) -> float:
    """Return the share of the photos that clearly show what the model does not."""
    return fmean(masks.difference(camera) > CLEAR for camera in masks.cameras)


def _average_cells(image: Tensor, target: Tensor, mask: Tensor | None) -> Tensor:
    """Return the absolute mean difference of a render and its photo in the cells, smoothed; 0 where no pixel counts.

    The result is (CELLS, CELLS).
    """
    difference = image.clamp(0, 1) - as_float(target)
    if mask is not None:
        difference = torch.where(mask, difference, 0.0)
    cells = adaptive_avg_pool2d(difference, CELLS)
    return avg_pool2d(cells, 3, stride=1, padding=1, count_include_pad=False).abs().mean(0)


FOLDER = "robust_masks"  # of a model folder: mask files of what was masked at the end


def write_masks(masks: Residuals, model_path: str | os.PathLike, source_path: str, background: Tensor) -> str:
    """Write FOLDER and MASK_PICTURE into a model folder, in place of older ones. Return a line about what they show."""
    model, shares = Path(model_path), {}
    folder, picture = model / FOLDER, model / MASK_PICTURE
    shutil.rmtree(folder, ignore_errors=True)
    picture.unlink(missing_ok=True)
    given = [camera.image_name for camera in masks.cameras]
    names = dict(zip(given, names_below(given, Path(source_path)), strict=True))
    for camera in masks.cameras:
        if (counts := masks.counted(camera)) is None:
            continue
        shares[camera.image_name] = 1 - float(counts.float().mean())
        with atomic_write(folder / f"{names[camera.image_name]}.png") as temporary:
            Image.fromarray(counts[0].to(torch.uint8).mul(255).cpu().numpy()).save(temporary)
    shares = dict(sorted(shares.items(), key=lambda named: -named[1]))
    if shares:
        _draw(masks, shares, background, picture)
    views = len(masks.cameras)
    most = [f"{name} ({share:.0%})" for name, share in shares.items()]
    text = f"--robust_mask leaves out {sum(shares.values()) / views:.1%} of the pixels"
    text += f", in {len(shares)} of {views} photos"
    return text + (f", most in {some(most)}; {folder} shows them" if most else "")


def _draw(masks: Residuals, shares: dict[str, float], background: Tensor, path: Path) -> None:
    """Draw photos beside copies whose masked parts are darker.

    shares: masked shares by photo, the largest first.
    """
    rows, cameras = [], {camera.image_name: camera for camera in masks.cameras}
    for name in list(shares)[:WORST]:
        photo = as_float(cameras[name].target(background))
        both = photo, dim_masked(photo, masks.counted(cameras[name]))
        images = [Image.fromarray(to_bytes(image).numpy()) for image in both]
        rows.append(list(zip((name, f"{shares[name]:.0%}"), images, strict=True)))
    with atomic_write(path) as temporary:
        sheet(("photo", "left out: dark"), rows, WIDEST).save(temporary)
