"""Watches that end or warn a training: losses and steps that are not finite, masks that leave nothing to train on."""

import math
import sys
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from tqdm import tqdm

from gaussian_renderer import visible_mask
from groundwork.host.listing import some
from scene.cameras import Camera
from scene.checks.points import OTHER_FORMS
from scene.gaussians.adam import StepGuard
from splatting.iteration import Iteration, Losses
from splatting.part import Error, Part
from splatting.save import write_checkpoint
from utils.system_utils import UserError

if TYPE_CHECKING:
    from splatting.run import Run

_COMPARED = 10  # losses compared, at the start and at the end, each of a different view
_NEVER = 1 << 62  # an iteration
_WORSE_AFTER = 100  # iterations after which a loss should have fallen


class DivergenceWatch(Part):
    """Checks, in iterations that are due (`Iteration.due`), that all losses and steps of optimisers were finite.

    The optimisers change nothing after the first one that was not (StepGuard), so that even a late check finds the
    model as it was.
    """

    def __init__(self, run: "Run") -> None:
        """Give the run's optimisers a guard, which holds back steps after the first one that is not finite."""
        self._run, self._losses = run, run.losses
        self._iteration = run.first_iteration
        self._guard = StepGuard(run.device)
        run.gaussians.guard_steps(self._guard)
        self._earliest: list[float] = []
        self._latest: deque[float] = deque(maxlen=_COMPARED)

    def measured(self, at: Iteration, losses: Losses) -> None:
        self._losses.add(at.iteration, losses.total)
        self._guard.watch(at.iteration, losses.total)
        if at.due:
            self.check(at.iteration)

    def check(self, iteration: int) -> None:
        """Save the model with a checkpoint, and raise UserError, if a loss or a step was not finite.

        Call it in every iteration that writes a file, changes the number of Gaussians, zeroes Adam's averages, or
        raises the SH degree.
        """
        losses = self._losses.read()
        self._earliest = [*self._earliest, *losses.values()][:_COMPARED]
        self._latest.extend(losses.values())
        self._iteration = iteration
        bad = next((t for t, loss in losses.items() if not math.isfinite(loss)), _NEVER)
        bad, stopped = self._run.group.all_gather_host_ints(bad, self._guard.stopped_in() or _NEVER).amin(0).tolist()
        first = min(bad, stopped)
        if first == _NEVER:
            return
        # With its loss, the whole step of an iteration is held back; else only that of the values that had none.
        what, good = ("the loss", first - 1) if bad == first else ("a step", first)
        view = self._run.views[first].image_name
        raise UserError(
            f"{what} of iteration {first} (view {view}) is not finite, so training stopped; "
            f"{self._save_good(good, iteration)}, or check this view and the point cloud"
        )

    def _save_good(self, good: int, iteration: int) -> str:
        """Save the model after the iteration `good`, unchanged since. Return what was saved, and what to do."""
        run = self._run
        if good == run.first_iteration:
            return "nothing was trained before; lower the learning rates"
        run.gaussians.drop_held_steps(max(iteration - 1 - good, 0))
        self._guard.stopped.zero_()  # sleeping blocks take the steps that they have missed
        run.stop_skipping()
        path = write_checkpoint(run, good, with_ply=True)
        return f"the model is saved: resume with --start_checkpoint {path} and lower learning rates"

    def ended(self, error: Error) -> None:
        """Warn if the loss of a training is above that of its start."""
        if error is not None or self._run.first_iteration > 0 or self._iteration < _WORSE_AFTER:
            return
        before, after = (sum(losses) / len(losses) for losses in (self._earliest, self._latest))
        if after > before:
            tqdm.write(
                f"warning: the loss rose from {before:.3g} to {after:.3g}, so the model is worse than its start; lower "
                "the learning rates, or check poses and photos (doctor.py)",
                file=sys.stderr,
            )


def check_drawn(run: "Run") -> None:
    """Refuse a start that no view shows (UserError), as no step would change anything. Every rank must call it."""
    views = run.scene.getTrainCameras()
    for view in views:
        if run.group.all_gather_host_ints(int(visible_mask(view, run.gaussians, run.pipe).any())).any():
            return
    raise UserError(f"none of the {len(views)} training views shows any Gaussian of the start; {OTHER_FORMS}")


_ENOUGH = 100  # if so many views have no pixel that counts, and no view has one, the masks are wrong
_ALMOST_NOTHING = 1e-3  # share of the pixels
_INVERT = "give --invert_masks if white is masked in them, or the masks of this scene"
_BLACK = "masks must be white where photos count; correct the masks, or leave them out"


class MaskWatch(Part):
    """Adds up how much of each view counts. Only `check` waits for a GPU, and only while views are new.

    No mask is decoded ahead for this, so training on thousands of photos starts in seconds.

    views: training views.
    """

    def __init__(self, views: Sequence[Camera]) -> None:
        """Begin with all views unseen."""
        self._left = {view.uid for view in views}
        self._views = len(views)
        self._new: list[tuple[str, Tensor]] = []  # name, and share of its pixels that count
        self._nothing = self._partly = 0
        self._scanty: list[str] = []
        self._seen = 0

    def measured(self, at: Iteration, losses: Losses) -> None:
        self.add(at.camera, losses.mask)
        if at.due:
            self.check(at.last)

    def add(self, view: Camera, mask: Tensor | None) -> None:
        """Note the share of pixels that count in a view, when the view is seen for the first time."""
        if view.uid not in self._left:
            return
        self._left.remove(view.uid)
        if mask is None:
            self._seen += 1
        else:
            part = mask if view.columns is None else mask[..., view.columns]
            self._new.append((view.image_name, part.float().mean()))

    def check(self, last: bool) -> None:
        """Name the views with hardly any pixel that counts, after all views were seen or in the last iteration.

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
