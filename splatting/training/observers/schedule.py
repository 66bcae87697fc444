"""schedule.json of a paced training, and what became of its time budget."""

from pathlib import Path

from arguments import add_to_model_json
from splatting.host.process import wall_seconds
from splatting.training.observer import Error, Observer
from splatting.training.run import Run
from splatting.training.schedule.pace import Paced
from splatting.training.schedule.schedule_file import NAME, write_schedule
from splatting.training.step import Step


def save_schedule(run: Run, step: Step) -> None:
    """Write what the pace has decided up to an iteration, if it decides anything; the sizes of views to model.json."""
    if isinstance(run.pace, Paced):
        folder = run.scene.model_path
        write_schedule(Path(folder) / NAME, run.pace.recorded(step.iteration, step.last))
        if run.opt.time_budget:
            add_to_model_json(folder, resolution_schedule=run.pace.sizes)


class ScheduleFile(Observer):
    """Writes schedule.json when the training ends, also by an error whose rescue has saved a checkpoint."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._step: Step | None = None
        self._seconds = 0.0

    def stepped(self, step: Step) -> None:
        self._step = step
        if step.last:
            self._seconds = self._run.log.seconds_before + self._run.clock.seconds

    def ended(self, error: Error) -> None:
        run = self._run
        if self._step is None:
            return
        save_schedule(run, self._step)
        if error is None and run.opt.time_budget:
            run.log.tell(
                f"Trained {self._seconds:.2f} s in {self._step.iteration} iterations for --time_budget "
                f"{run.opt.time_budget:g}; the whole process, with reading, scoring and saving, took "
                f"{run.log.wall_seconds_before + wall_seconds():.1f} s"
            )
