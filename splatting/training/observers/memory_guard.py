"""Memory that runs out."""

import traceback
from pathlib import Path

from gaussian_renderer.memory_errors import situation
from scene.cameras import Camera
from scene.gaussians.checkpoint import save_checkpoint
from splatting.host.memory import is_out_of_memory
from splatting.training.iteration import Iteration, Losses
from splatting.training.part import Error, Part
from splatting.training.restart import what_stands
from splatting.training.run import Run
from utils.system_utils import UserError


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
