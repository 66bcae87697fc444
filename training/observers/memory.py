"""Where memory does not suffice the model is saved, and a sentence says what was wanted and what helps."""

import traceback
from pathlib import Path
from types import TracebackType

from gaussian_renderer.memory_errors import situation
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.gaussians.checkpoint import save_checkpoint
from utils.host.memory import is_out_of_memory
from utils.system_utils import UserError


class MemoryGuard:
    """Inside `with`, where a training runs out of memory the model is saved and the error becomes a UserError.

    The training says where it is: `reached` (an iteration is complete), `working` (which view), `changing` (from here
    on the model is between two iterations). Before `changing`, what is saved is the state after the last iteration, and
    going on from it equals a run that was never stopped. Afterwards it is a whole model, too, but that iteration's
    densification or optimiser step may be done in part.
    """

    def __init__(self, gaussians: GaussianModel, model_path: str, first_iteration: int) -> None:
        self._gaussians = gaussians
        self._folder = Path(model_path)
        self._first = first_iteration
        self.reached(first_iteration)

    def reached(self, iteration: int) -> None:
        """The model has the state after this iteration."""
        self._iteration = iteration
        self._sh_degree = self._gaussians.active_sh_degree
        self._changing = False
        self._camera: Camera | None = None

    def working(self, camera: Camera) -> None:
        """The next iteration has begun, with this view."""
        self._camera = camera

    def changing(self) -> None:
        """The next iteration begins to change the model."""
        self._changing = True

    def __enter__(self) -> "MemoryGuard":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if is_out_of_memory(error):
            what = situation(error, self._gaussians, [self._camera] if self._camera else [])
            traceback.clear_frames(trace)  # what was being computed takes memory that saving may need
            raise UserError(
                f"memory did not suffice in iteration {self._iteration + 1} ({what}); {self._rescue()}"
            ) from error

    def _rescue(self) -> str:
        """Save what there is. Says what was saved, and what to do."""
        if self._iteration == self._first and not self._changing:
            return "nothing was trained yet; lower --resolution (-r), --max_num_splats, --images_to_load or --sh_degree"
        gaussians, iteration = self._gaussians, self._iteration + self._changing
        anew, state = "--sh_degree", f"the model after iteration {iteration}"
        further = "a lower --resolution (-r) or --images_to_load"
        try:
            if self._changing:
                gaussians.take_from_optimizer()
                state = f"the model in iteration {iteration}, whose last changes may be done in part,"
                further = f"--max_num_splats {len(gaussians)}, {further}"
            else:
                gaussians.active_sh_degree = self._sh_degree
                anew = "--max_num_splats or --sh_degree"  # going on with as many would end here again
            gaussians.check_finite(iteration)
            gaussians.check_steps()
            path = self._folder / f"chkpnt{iteration}.pth"
            save_checkpoint(path, gaussians.capture(), iteration)
        except (UserError, MemoryError, RuntimeError) as error:
            return f"and the model could not be saved ({error}); go on from an earlier checkpoint"
        return (
            f"{state} is saved: go on with --start_checkpoint {path} and {further}, or start anew with a lower {anew}"
        )
