"""Guards of a training: masks that leave nothing to train on, and memory that runs out."""

import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from gaussian_renderer.memory_errors import situation
from scene.cameras import Camera
from scene.gaussians.checkpoint import save_checkpoint
from splatting.files.listing import some
from splatting.host.memory import is_out_of_memory
from splatting.training.iteration import Iteration, Losses
from splatting.training.part import Error, Part
from splatting.training.restart import what_stands
from splatting.training.run import Run
from utils.system_utils import UserError

_ENOUGH = 100  # if so many views have no pixel that counts, and no view has one, the masks are wrong
_ALMOST_NOTHING = 1e-3  # share of the pixels
_INVERT = "is white masked in them (--invert_masks), or do they belong to another scene?"
_BLACK = "white must be where photos count; make the masks again, or leave them out"


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
                f"warning: the masks of {len(self._scanty)} of {self._seen} views leave none or almost none of their "
                f"pixels ({some(self._scanty)}), so these views teach nothing; "
                # Where all are black, inverted masks would keep everything.
                f"{_INVERT if self._partly else _BLACK}",
                file=sys.stderr,
            )
            self._scanty.clear()


class MemoryGuard(Part):
    """Saves the model when memory runs out, and turns the error into a UserError.

    Until an iteration is `measured`, the saved state is that after the iteration before: a resumed run then equals one
    that was never stopped. After that, the saved model is usable as well, but densification or the optimiser's step may
    be incomplete. So this observer comes after those that only read the model, and before those that need it whole.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self._gaussians = run.gaussians
        self._folder = Path(run.scene.model_path)
        self._first = run.first_iteration
        self._reached(run.first_iteration)

    def _reached(self, iteration: int) -> None:
        self._iteration = iteration
        self._sh_degree = self._gaussians.active_sh_degree
        self._changing = False
        self._camera: Camera | None = None

    def begins(self, step: Iteration) -> None:
        self._camera = step.camera

    def measured(self, step: Iteration, losses: Losses) -> None:
        self._changing = True

    def stepped(self, step: Iteration) -> None:
        self._reached(step.iteration)

    def ended(self, error: Error) -> None:
        self._iteration -= self._run.lost
        if is_out_of_memory(error):
            what = situation(error, self._gaussians, [self._camera] if self._camera else [])
            traceback.clear_frames(error.__traceback__)  # their tensors take memory that saving may need
            raise UserError(
                f"training ran out of memory in iteration {self._iteration + 1} ({what}); {self._rescue()}"
            ) from error

    def _rescue(self) -> str:
        """Save the model, unless other processes have parts of it. Return what was saved, and what to do."""
        if self._run.group.several:
            stands = what_stands(self._run.scene.model_path, self._run.start)
            return f"{stands}, with a lower --resolution (-r), --max_num_splats or --images_to_load"
        if self._iteration == self._first and not self._changing:
            return "nothing was trained yet; lower --resolution (-r), --max_num_splats, --images_to_load or --sh_degree"
        gaussians, iteration = self._gaussians, self._iteration + self._changing
        anew, state = "--sh_degree", f"the model after iteration {iteration}"
        further = "a lower --resolution (-r) or --images_to_load"
        try:
            if self._changing:
                gaussians.take_from_optimizer()
                state = f"the model in iteration {iteration}, whose last changes may be incomplete,"
                further = f"--max_num_splats {gaussians.gaussian_count}, {further}"
            else:
                gaussians.active_sh_degree = self._sh_degree
                anew = "--max_num_splats or --sh_degree"  # a resumed run with as many Gaussians would end here again
            path = self._folder / f"chkpnt{iteration}.pth"
            with self._run.flushed_view():
                gaussians.check_finite(iteration)
                gaussians.check_steps()
                save_checkpoint(path, self._run.checkpoint_state(), iteration)
        except (UserError, MemoryError, RuntimeError) as error:
            return f"and the model could not be saved ({error}); resume an earlier checkpoint"
        return (
            f"{state} is saved: resume with --start_checkpoint {path} and {further}, or start again with a lower {anew}"
        )
