"""The web page that shows a training and controls it."""

import sys
import time

from tqdm import tqdm

from splatting.training.observer import Error, Observer
from splatting.training.observers.saves import Checkpoints
from splatting.training.run import Run
from splatting.training.step import Step
from splatting.viewer.options import Address
from splatting.viewer.page import Page
from splatting.viewer.training_tab import Requests, TrainingTab
from splatting.viewer.watchers import MOVING, STILL, Budget, Wish
from utils.system_utils import UserError

_NUMBERS_EVERY = 0.5  # seconds
_WAIT = 0.2  # seconds until a paused training notices a signal


class PageObserver(Observer):
    """Draws frames for the page between two iterations, and does what its buttons ask for.

    While nobody watches it asks one variable in each iteration. The time it takes is not that of training. It comes
    last, so that a paused training has done all else that belongs to its iteration.
    """

    def __init__(self, run: Run, checkpoints: Checkpoints) -> None:
        """Start the page at the address of --viewer. UserError as from `Page`."""
        self._run, self._checkpoints = run, checkpoints
        address = Address(run.launch.viewer_host, run.launch.viewer)
        self._page = Page(address, run.scene, run.pipe, run.dataset.white_background, run.dataset.train_test_exp)
        self._requests = Requests(self._page.watchers.wake)
        with self._page.tabs.add_tab("Training"):
            self._tab = TrainingTab(self._page.server, self._requests)
        self.budget = Budget()
        self._wish: Wish | None = None
        self._numbers = (0.0, 0, 0.0)  # when they were shown, the iteration, and its seconds of training

    def due(self, step: Step) -> bool:
        self._wish = None
        if self._page.watchers.any:
            wish = self._page.watchers.next(step.iteration)
            if wish is not None and self.budget.allows(MOVING if wish.urgent else STILL):
                self._wish = wish
        return self._wish is not None or self._requests.any

    def stepped(self, step: Step) -> None:
        if step.due and not step.stopping and (self._wish is not None or self._requests.any):
            with self._run.clock.paused("viewing"):
                self._act(step)
        if self._page.watchers.any and time.perf_counter() - self._numbers[0] >= _NUMBERS_EVERY:
            self._show_numbers(step.iteration)

    def _act(self, step: Step) -> None:
        if self._wish is not None:
            self._draw(self._wish, step.iteration)
        if self._requests.any and not step.last:
            self._obey(step)

    def _draw(self, wish: Wish, version: int) -> None:
        began = time.perf_counter()
        self._page.fulfil(wish, version)
        self.budget.spent(began, time.perf_counter() - began)

    def _obey(self, step: Step) -> None:
        """Do what was asked for, and return when the training is to go on, or with `step.stopping` set."""
        run, requests = self._run, self._requests
        if requests.paused:
            self._show_numbers(step.iteration)
        while True:
            if requests.stopped or run.interrupt.requested:
                step.stopping = run.interrupt.requested or KeyboardInterrupt
                self._checkpoints.save(step)
                return
            if requests.take_checkpoint():
                self._save(step)
            if not requests.paused or requests.take_step():
                return
            wish = self._page.watchers.next(step.iteration)
            if wish is None:
                self._page.watchers.wait(_WAIT)
            else:
                self._draw(wish, step.iteration)

    def _save(self, step: Step) -> None:
        """Save a checkpoint. A disk that is full is told, and ends nothing."""
        try:
            self._checkpoints.save(step)
        except UserError as error:
            if not isinstance(error.__cause__, OSError):  # such as a loss that is not finite
                raise
            tqdm.write(f"warning: {error}", file=sys.stderr)
            self._page.tell("Not saved", str(error))
        else:
            self._page.tell("Saved", f"chkpnt{step.iteration}.pth")

    def _show_numbers(self, iteration: int) -> None:
        run, now = self._run, time.perf_counter()
        _, before, seconds = self._numbers
        if iteration == before:  # a pause has shown it
            return
        self._numbers = now, iteration, run.clock.seconds
        took = run.clock.seconds - seconds
        speed = (iteration - before) / took if before and took > 0 else None
        self._page.show_numbers(iteration, run.gaussians.total)
        self._tab.show(speed, run.losses.mean, run.rows)

    def ended(self, error: Error) -> None:
        if error is None:
            self._page.tell("The training is done", f"See it by python view.py -m {self._run.scene.model_path}")
        else:
            self._page.tell("The training has stopped", "Its terminal says why, and how to resume it")
        self._page.stop()
