"""The observers of a training, in their order."""

from collections.abc import Callable
from typing import Any

from gaussian_renderer import network_gui
from splatting.training.observers.divergence import DivergenceWatch
from splatting.training.observers.guards import MaskWatch, MemoryGuard
from splatting.training.observers.report import ProgressBar, Records, Report, Summary, training_report
from splatting.training.observers.saves import Checkpoints, Saves
from splatting.training.observers.viewers import NetworkViewer, PageObserver
from splatting.training.part import Part
from splatting.training.run import Run


def standard_observers(run: Run, writer: Any | None, report: Callable[..., dict[str, float]]) -> list[Part]:
    """The observers of every training. writer: TensorBoard's, or None. report: `training_report`."""
    if report is not training_report:
        run.stop_skipping()  # it may read or change the model in every iteration
    watch = DivergenceWatch(run)
    checkpoints = Checkpoints(run, watch)
    return [
        watch,  # first: observers that write rely on all losses so far being finite
        *([ProgressBar(run)] if run.group.first else []),  # reads the losses that the watch has checked
        MaskWatch(run.scene.getTrainCameras()),  # may refuse the scene before anything is written
        *run.parts,
        Report(run, writer, report),
        Saves(run),  # before the model changes
        Records(run),  # after all that add to the iteration's record
        Summary(run),  # after all that say something at the end
        *([NetworkViewer(run)] if network_gui.listener else []),  # after all that write: it may make training wait
        MemoryGuard(run),  # from `measured` to `stepped` the model changes; otherwise it is whole
        checkpoints,  # writes the whole state after the step
        *([PageObserver(run, checkpoints)] if run.launch.viewer is not None else []),  # last: may let the training wait
    ]
