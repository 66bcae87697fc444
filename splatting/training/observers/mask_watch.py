"""Masks that leave nothing to train on."""

import sys
from collections.abc import Sequence

import torch
from torch import Tensor
from tqdm import tqdm

from scene.cameras import Camera
from splatting.host.listing import some
from splatting.part import Part
from splatting.training.iteration import Iteration, Losses
from utils.system_utils import UserError

_ENOUGH = 100  # if so many views have no pixel that counts, and no view has one, the masks are wrong
_ALMOST_NOTHING = 1e-3  # share of the pixels
_INVERT = "give --invert_masks if white is masked in them, or the masks of this scene"
_BLACK = "masks must be white where photos count; correct the masks, or leave them out"


class MaskWatch(Part):
    """Adds up, without waiting for a GPU, how much of each view counts. Only `look` waits for it, while views are new.

    views: those that train. This check decodes no mask ahead, so training on thousands of photos starts in seconds.
    """

    def __init__(self, views: Sequence[Camera]) -> None:
        self._left = {view.uid for view in views}
        self._views = len(views)
        self._new: list[tuple[str, Tensor]] = []  # name, and share of its pixels that count
        self._nothing = self._partly = 0
        self._scanty: list[str] = []
        self._seen = 0

    def measured(self, step: Iteration, losses: Losses) -> None:
        self.add(step.camera, losses.mask)
        if step.due:
            self.look(step.last)

    def add(self, view: Camera, mask: Tensor | None) -> None:
        """Note the share of pixels that count in a view seen for the first time."""
        if view.uid not in self._left:
            return
        self._left.remove(view.uid)
        if mask is None:
            self._seen += 1
        else:
            part = mask if view.columns is None else mask[..., view.columns]
            self._new.append((view.image_name, part.float().mean()))

    def look(self, last: bool) -> None:
        """After all views were seen, or in the last iteration, name those with hardly any pixel that counts.

        UserError if no pixel counts in any view, or in any of the first hundred.
        """
        if self._new:
            for (name, _), part in zip(self._new, torch.stack([part for _, part in self._new]).tolist(), strict=True):
                self._seen += 1
                self._nothing += part == 0
                self._partly += part > 0
                if part < _ALMOST_NOTHING:
                    self._scanty.append(name)
            self._new.clear()
        if self._nothing == self._seen >= min(self._views, _ENOUGH):
            raise UserError(f"the masks of all {self._seen} views seen so far leave no pixel to train on; {_BLACK}")
        if self._scanty and (last or not self._left):
            tqdm.write(
                f"warning: the masks of {len(self._scanty)} of {self._seen} views exclude all or almost all of their "
                f"pixels ({some(self._scanty)}), so these views do not contribute; "
                # Where all are black, inverted masks would keep everything.
                f"{_INVERT if self._partly else _BLACK}",
                file=sys.stderr,
            )
            self._scanty.clear()
