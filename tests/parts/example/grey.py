"""A worked example of a part: a loss term with an option, a state, and numbers in the log (tests/test_example.py)."""

from typing import Any

from splatting.iteration import Iteration, Losses, Term
from splatting.objective import LossWatch
from splatting.part import Error, Part


class Grey(Part):
    """Draws renders towards grey: adds the weighted mean spread of a pixel's three channels to the loss."""

    name = "grey"  # of the file, of the state in a checkpoint, and of the option that brings the part in

    def begin(self, run: Any, state: Any) -> None:
        self._run = run
        self._mean = LossWatch(0.0 if state is None else state["mean"])  # a running mean, of the whole training

    def terms(self, at: Iteration) -> dict[str, Term]:
        weight, columns = self._run.opt.grey, at.camera.columns or slice(None)

        def term(package: dict[str, Any], mask: Any) -> Any:
            spread = package["render"].std(0, keepdim=True)[..., columns]
            return weight * (spread if mask is None else spread * mask[..., columns]).mean()

        return {"grey": term}

    def measured(self, at: Iteration, losses: Losses) -> None:
        self._mean.add(at.iteration, losses.terms["grey"])  # noted, not read: the GPU may be some steps behind

    def records(self) -> dict[str, float]:
        self._mean.read()
        return {"grey": self._mean.mean}

    def state(self) -> dict[str, float]:
        return {"mean": self.records()["grey"]}

    def ended(self, error: Error) -> None:
        if error is None:
            self._run.log.tell(f"--grey: the running mean of the term is {self.records()['grey']:.4f} at the end")
