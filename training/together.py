"""Agreement of the ranks of a training in each iteration, by one exchange of numbers between their processors."""

from training.run import Run
from training.step import Step
from utils.host.interrupt import Terminated
from utils.ranks.ranks import ranks

_SIGNALS = (None, KeyboardInterrupt, Terminated)
_WARM = 2  # iterations of a run after which a step takes as long as the others


class Together:
    """Shares whether an iteration is due, which signal asks to stop, and where the guard has stopped the optimisers.

    A signal counts for the iteration that begins after it, on all ranks, whichever has got it. Flags of a guard on a
    GPU are shared there, and nobody waits for it.
    """

    def __init__(self, run: Run) -> None:
        self._run, self._ranks = run, ranks()
        self._guard = getattr(run.gaussians.optimizer, "guard", None)
        self._asked: type[KeyboardInterrupt] | None = None

    def begins(self, step: Step) -> None:
        """Share what is known when an iteration begins, after the observers were asked whether it is due."""
        if not self._ranks.several:
            return
        flag = None if self._guard is None else self._guard.stopped
        on_cpu = flag is not None and not flag.is_cuda
        signal = _SIGNALS.index(self._run.interrupt.requested)
        shared = self._ranks.numbers(int(step.due), signal, int(flag) if on_cpu else 0).amax(0).tolist()
        step.due, self._asked = bool(shared[0]), _SIGNALS[shared[1]]
        if on_cpu:
            flag.fill_(shared[2])
        elif flag is not None:
            self._ranks.largest_(flag)
        self._ranks.prompt = step.iteration - self._run.first_iteration > _WARM

    @property
    def stopping(self) -> type[KeyboardInterrupt] | None:
        """What asks to stop after this iteration."""
        return self._asked if self._ranks.several else self._run.interrupt.requested

    def wait(self) -> None:
        """Wait for all ranks, as until the first has written a checkpoint."""
        self._ranks.anyone(False)

    def ended(self) -> None:
        """Let the others wait as long as it takes from now on."""
        self._ranks.prompt = False
