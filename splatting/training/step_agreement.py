"""Agreement of the processes of a training in each iteration, without an exchange of its own."""

from splatting.host.interrupt import Terminated
from splatting.training.division import FAULT, Division
from splatting.training.iteration import Iteration
from splatting.training.objective import Losses
from splatting.training.observer import Observer
from splatting.training.run import Run

_SIGNALS = (None, KeyboardInterrupt, Terminated)
_WARM = 2  # iterations of a run after which a step takes as long as the others


class StepAgreement(Observer):
    """Shares whether an iteration is due, which signal asks to stop, and where the guard has stopped the optimisers.

    These go with the numbers that they exchange to render the iteration's view (`agree`), and are known when its
    losses are. A signal counts for the iteration that begins after it, on all, whichever has got it.

    While each rank trains the whole model (`Run.whole`), an exchange of its own tells of signals, and whether to divide
    the model, but only where all blocks of Gaussians wake.
    """

    def __init__(self, run: Run) -> None:
        self._run, self._group = run, run.group
        if self._group.several:
            guard = getattr(run.gaussians.optimizer, "guard", None)
            self._group.flag = None if guard is None else guard.stopped
        self._asked: type[KeyboardInterrupt] | None = None
        self._division, self._pays = Division(run) if run.whole else None, 0

    def begins(self, step: Iteration) -> None:
        self._group.post(int(step.due), _SIGNALS.index(self._run.interrupt.requested))
        # Whole models meet seldom, and each process decodes its photos in the first epoch.
        slow = len(self._run.scene.getTrainCameras()) if self._run.whole else 0
        self._group.prompt = step.iteration - self._run.first_iteration > _WARM + slow

    def measured(self, step: Iteration, losses: Losses) -> None:
        signal = 0
        if not self._run.whole:
            due, signal = self._group.heard()
            step.due = bool(due)
        elif step.last or self._run.wakes_all(step):
            signal = self._meet(self._division.pays(step))
        self._asked = _SIGNALS[signal]

    def _meet(self, pays: bool) -> int:
        """Agree on a signal, and whether to divide the model."""
        signal = _SIGNALS.index(self._run.interrupt.requested)
        signal, self._pays = self._group.numbers(signal, int(pays)).amax(0).tolist()
        if signal == FAULT:
            self.wait()  # until the one that has to end, and says why, is gone
        return signal

    @property
    def stopping(self) -> type[KeyboardInterrupt] | None:
        """What asks to stop after this iteration."""
        return self._asked if self._group.several else self._run.interrupt.requested

    def divides(self, step: Iteration) -> bool:
        """Whether the model is to be divided after an iteration, which is done."""
        return self._run.whole and bool(self._pays) and not step.last

    def wait(self) -> None:
        """Wait for all, as until the first has written a checkpoint."""
        self._group.anyone(False)

    def finish(self) -> None:
        """Let the others wait as long as it takes from now on."""
        if self._run.whole:
            self._meet(False)
        self._group.prompt = False
