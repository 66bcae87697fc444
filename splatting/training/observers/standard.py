"""The observers of a training, in their order."""

from splatting.part import Part
from splatting.training.observers.divergence import DivergenceWatch
from splatting.training.observers.mask_watch import MaskWatch
from splatting.training.observers.progress import ProgressBar, Summary
from splatting.training.observers.records import Records
from splatting.training.observers.report import Scores, training_report
from splatting.training.observers.saves import Checkpoints, Saves
from splatting.training.run import Run


def standard_observers(run: Run) -> list[Part]:
    """The observers of every training, and the run's parts in their places among them."""
    if run.report is not training_report:
        run.stop_skipping()  # it may read or change the model in every iteration
    watch = DivergenceWatch(run)
    run.checkpoints = Checkpoints(run, watch.look)
    return [
        watch,  # first: observers that write rely on all losses so far being finite
        *([ProgressBar(run)] if run.group.first else []),  # reads the losses that the watch has checked
        MaskWatch(run.scene.getTrainCameras()),  # may refuse the scene before anything is written
        *(part for part in run.parts if not part.waits),
        Scores(run),
        Saves(run),  # before the model changes
        Records(run),  # after all that add to the iteration's record
        Summary(run),  # after all that say something at the end
        run.checkpoints,  # writes the whole state after the step
        *(part for part in run.parts if part.waits),
    ]
