"""The web page that shows and controls a training."""

import sys
import time

from tqdm import tqdm

from applications.viewer.page import Page, serve
from applications.viewer.training_tab import TrainingTab
from applications.viewer.watchers import MOVING, STILL, Budget, Wish
from groundwork.host.listing import as_utf8
from scene.saved_model import read_model
from splatting.iteration import Iteration
from splatting.part import Error, Part
from splatting.records.error_curve import common_subset, rows_on
from splatting.run import Run
from utils.system_utils import UserError, saved_ply

_NUMBERS_EVERY = 0.5  # seconds
_WAIT = 0.2  # seconds until a paused training notices a signal


class TrainingPage(Part):
    """Draws frames for the page between two iterations, and does what its buttons ask for.

    While nobody watches it asks one variable in each iteration. The time it takes is not that of training.
    """

    def __init__(self, run: Run) -> None:
        """Start the page. UserError as from `Page`."""
        self._run = run
        self._page = Page(run.launch.viewer, run.scene, run.pipe, run.dataset.white_background, run.scene.halves)
        self._requests = self._page.requests
        if run.pixel_filter:
            self._page.frames.masks = run.pixel_filter.counted
        with self._page.tabs.add_tab("Training"):
            self._tab = TrainingTab(self._page.server, self._requests)
        if run.launch.paused:
            self._tab.begin_paused()
        self.budget = Budget()
        self._wish: Wish | None = None
        self._numbers = (0.0, 0, 0.0)  # when they were shown, the iteration, and its seconds of training
        self._step: Iteration | None = None

    def due(self, at: Iteration) -> bool:
        """Tell if a frame or a request of the page is to be done in this iteration; choose the frame."""
        self._wish = None
        if self._page.watchers.any:
            wish = self._page.watchers.next(at.iteration)
            if wish is not None and self.budget.allows_frame(MOVING if wish.urgent else STILL):
                self._wish = wish
        return self._wish is not None or self._requests.any

    def stepped(self, at: Iteration) -> None:
        """Do what is due, outside of the clock of the training, and show numbers now and then."""
        self._step = at
        if at.due and not at.stopping and (self._wish is not None or self._requests.any):
            with self._run.clock.paused("viewing"):
                self._act(at)
        if self._page.watchers.any and time.perf_counter() - self._numbers[0] >= _NUMBERS_EVERY:
            self._show_numbers(at.iteration)

    def _act(self, at: Iteration) -> None:
        if self._wish is not None:
            self._draw(self._wish, at.iteration)
        if self._requests.any and not at.last:
            self._fulfil_requests(at)

    def _draw(self, wish: Wish, version: int) -> None:
        began = time.perf_counter()
        self._page.fulfil(wish, version)
        self.budget.note_frame(began, time.perf_counter() - began)

    def _fulfil_requests(self, at: Iteration) -> None:
        """Do what was asked for, and return when the training is to go on, or with `step.stopping` set."""
        run, requests = self._run, self._requests
        if requests.paused:
            self._show_numbers(at.iteration, paused=True)
        while True:
            if requests.stopped or run.interrupt.requested:
                at.stopping = run.interrupt.requested or KeyboardInterrupt("stopped from the page")
                self._run.checkpoints.save(at)
                return
            if requests.take_checkpoint():
                self._save(at)
            requests.work()
            if not requests.paused or requests.take_step():
                return
            wish = self._page.watchers.next(at.iteration)
            if wish is None:
                self._page.watchers.wait(_WAIT)
            else:
                self._draw(wish, at.iteration)

    def _save(self, at: Iteration) -> None:
        """Save a checkpoint. A full disk is reported, and does not end the training."""
        try:
            self._run.checkpoints.save(at)
        except UserError as error:
            if not isinstance(error.__cause__, OSError):  # such as a loss that is not finite
                raise
            tqdm.write(f"warning: {error}", file=sys.stderr)
            self._page.notify("Not saved", str(error), color="red")
        else:
            self._page.notify("Saved", f"chkpnt{at.iteration}.pth")

    def _show_numbers(self, iteration: int, paused: bool = False) -> None:
        """Show iteration, Gaussians, speed, time to go, loss and curve on the page."""
        run, now = self._run, time.perf_counter()
        _, before, seconds = self._numbers
        expected = run.schedule.expected
        of = "" if expected is None else f" of {'about ' if run.schedule.by_clock else ''}{round(expected):,}"
        of += ", paused" if paused else ""
        self._page.show_numbers(iteration, run.gaussians.gaussian_count, of)
        if iteration == before:  # a pause has shown the rest
            return
        self._numbers = now, iteration, run.clock.seconds
        took = run.clock.seconds - seconds
        speed = (iteration - before) / took if before and took > 0 else None
        subset = common_subset([run.rows])
        left = self._guess_seconds_left(iteration, speed)
        self._tab.show(speed, left, run.losses.mean, rows_on(run.rows, subset), subset)

    def _guess_seconds_left(self, iteration: int, speed: float | None) -> float | None:
        """Seconds of training to go; None: not known."""
        run = self._run
        if run.schedule.by_clock:
            return max(0.0, run.schedule.until - run.log.seconds_before - run.clock.seconds)
        if run.schedule.expected is None or not speed:
            return None
        return max(0.0, run.schedule.expected - iteration) / speed

    def ended(self, error: Error) -> None:
        """Let the page stay, unless an error or a signal ended the training."""
        run = self._run
        by_button = isinstance(error, KeyboardInterrupt) and self._requests.stopped and not run.interrupt.requested
        if error is not None and not by_button:
            self._page.notify("The training has stopped", "Its terminal says why, and how to resume it")
        else:
            saved = as_utf8(f"{run.scene.model_path}/chkpnt{self._step.iteration}.pth")
            self._stay_open(f"stopped and saved as {saved}" if by_button else "complete")

    def close(self) -> None:
        """Stop listening."""
        self._page.stop()

    def _stay_open(self, how: str) -> None:
        """Serve the page until it is closed or a signal comes; all of the training is written by now."""
        run, step = self._run, self._step
        self._show_numbers(step.iteration)
        if step.last and step.takes(run.launch.save_iterations):
            self._show_saved(step.iteration)  # the last step has changed the model after that
        self._requests.reset()
        self._tab.end(
            f"The training is {how}. This page stays open until you close it, or until Ctrl-C in its terminal."
        )
        self._page.notify("The training is over", f"It is {how}; the page stays open")
        sys.stdout.flush()  # which may be a pipe
        line = f"The page stays open at {self._page.url} until you close it there, or until Ctrl-C"
        tqdm.write(line, file=sys.stderr)
        serve(self._page)

    def _show_saved(self, iteration: int) -> None:
        """Show the model that was saved at the end of the training, in place of the one in memory."""
        run, path = self._run, saved_ply(self._run.scene.model_path, iteration)
        gaussians = read_model(path)
        if run.scene.halves:
            gaussians.load_exposures(run.scene.model_path, run.scene.info.train_cameras)
        gaussians.world_offset, gaussians.enlargement = run.gaussians.world_offset, run.gaussians.enlargement
        self._page.show_model(gaussians, iteration)
