"""A worked example of a part: a loss term with an option, a state, and a line in the report (tests/test_example.py)."""

from typing import TYPE_CHECKING, Any

from splatting.training.option import Option, at_least
from splatting.training.part import Error, Options, Part

if TYPE_CHECKING:
    from splatting.training.iteration import Iteration, Losses, Term


class Grey(Part):
    """Draws renders towards grey: adds the weighted mean spread of a pixel's three channels to the loss."""

    name = "grey"  # of the folder, of the state in a checkpoint, and of the option that brings the part in
    # fmt: off
    options = Options(optimisation=(
        Option("grey", 0.0, origin="ours", check=at_least(0),
            help="weight of the spread of colours in renders, which draws them towards grey; 0: off"),
    ))
    # fmt: on
    shown = {"grey": "Grey"}  # in the progress bar

    def begin(self, run: Any, state: Any) -> None:
        self._run = run
        self._first = None if state is None else state["first"]  # of the whole training, also where this one resumes
        self._last = None

    def terms(self, at: "Iteration") -> "dict[str, Term]":
        weight = self._run.opt.grey
        return {"grey": lambda package, mask: weight * package["render"].std(0).mean()}

    def measured(self, at: "Iteration", losses: "Losses") -> None:
        # Noted, not read: the GPU may be some steps behind.
        self._last = losses.terms["grey"]
        self._first = self._last if self._first is None else self._first

    def state(self) -> dict[str, float]:
        return {"first": float(self._first)}

    def ended(self, error: Error) -> None:
        if error is None:
            self._run.log.tell(f"--grey: {float(self._first):.4f} at first, {float(self._last):.4f} at the end")
