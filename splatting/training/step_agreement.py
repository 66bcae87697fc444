"""Agreement of the processes of a training in each iteration, without an exchange of its own."""

from splatting.host.interrupt import Terminated
from splatting.part import Part
from splatting.training.iteration import Iteration, Losses
from splatting.training.run import Run

_SIGNALS = (None, KeyboardInterrupt, Terminated)


class StepAgreement(Part):
    """Shares whether an iteration is due, which signal asks to stop, and where the guard has stopped the optimisers.

    These go with the numbers that they exchange to render the iteration's view (`agree`), and are known when its
    losses are. A signal counts for the iteration that begins after it, on all, whichever has got it.
    """

    def __init__(self, run: Run) -> None:
        self._run, self._group = run, run.group
        if self._group.several:
            guard = getattr(run.gaussians.optimizer, "guard", None)
            self._group.flag = None if guard is None else guard.stopped
        self._asked: type[KeyboardInterrupt] | None = None

    def begins(self, step: Iteration) -> None:
        self._group.post(int(step.due), _SIGNALS.index(self._run.interrupt.requested))

    def measured(self, step: Iteration, losses: Losses) -> None:
        due, signal = self._group.heard()
        step.due = bool(due)
        self._asked = _SIGNALS[signal]

    @property
    def stopping(self) -> type[KeyboardInterrupt] | None:
        """What asks to stop after this iteration."""
        return self._asked if self._group.several else self._run.interrupt.requested

    def wait(self) -> None:
        """Wait until the first has written what it writes: torchrun ends all once one has ended."""
        self._group.anyone(False)
