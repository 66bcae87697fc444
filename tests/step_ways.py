"""Ways to take a step of training, those of a GPU on any machine, and notes of which steps took them."""

from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

import pytest
import torch

from gaussian_renderer import Drawn
from scene.sleeping import Sleeping
from splatting.faster import captured, graphs
from splatting.faster.captured import CapturedStep
from splatting.faster.faster import FasterSteps
from splatting.faster.fused import FusedStep
from splatting.faster.graphs import Graphs
from splatting.faster.speculative import AHEAD


def fused_iterations(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A list to which every iteration that is not taken plainly will be appended."""
    fused, advance, launch = [], FusedStep.advance, Graphs.launch
    monkeypatch.setattr(FusedStep, "advance", lambda self, at, *x: (fused.append(at.iteration), advance(self, at, *x)))

    def noted(self, at):
        losses = launch(self, at)
        fused.extend([at.iteration] if losses else [])
        return losses

    monkeypatch.setattr(Graphs, "launch", noted)
    return fused


class Immediate:
    """Stands for Speculation where there is no GPU: every step is done at once, and reported as late as may be."""

    def __init__(self, _: object, steps: CapturedStep) -> None:
        self._pending, self._steps = deque(), steps
        self.drain = self.discard = self.wait = self._report
        self.throttle = lambda: self._report(AHEAD - 1)
        self.add = lambda at, _: self._pending.append(at)
        self.abort = lambda: None

    def _report(self, most: int = 0) -> None:
        while len(self._pending) > most:
            at = self._pending.popleft()
            self._steps._run.set_rates(at)  # as a replay would

    def capacity(self, at: object) -> AbstractContextManager:
        return nullcontext()


class Rerun:
    """Stands for Recorder where there is no GPU: a launch runs the function once more, which reads what lies there."""

    made: list["Rerun"] = []
    tight = False

    def __init__(self, *_: object) -> None:
        self.launches = self.records = self.released = 0
        Rerun.made.append(self)

    def capture(self, body: Callable[[], torch.Tensor]) -> tuple[Callable[[], None], torch.Tensor]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Drawn, "step", lambda *_: None)  # to capture a step does not take it
            patch.setattr(Sleeping, "wake", lambda self, *_: self.awake)
            result = body()
        self.records += 1

        def launch() -> None:
            self.launches += 1
            with pytest.MonkeyPatch.context() as patch:
                # Kernels run again, and no Python.
                patch.setattr(Sleeping, "stepped", lambda *_: None)
                result.copy_(body())

        return launch, result

    def is_tight(self) -> bool:
        return self.tight

    def release(self) -> None:
        self.released += 1


WAYS = {"fused": FusedStep, "queued": CapturedStep, "captured": CapturedStep}


@pytest.fixture
def take_as(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Lets steps be taken in a way of WAYS, as on a GPU, or plainly."""
    Rerun.made.clear()
    monkeypatch.setattr(captured, "Speculation", Immediate)
    monkeypatch.setattr(graphs, "Recorder", Rerun)

    def choose(way: str) -> None:
        chosen = WAYS.get(way, lambda _: FasterSteps())
        monkeypatch.setattr("splatting.loop.faster_steps", chosen)
        if way == "queued":
            monkeypatch.setattr(Graphs, "_is_usual", lambda *_: False)

    return choose
