"""The last save leaves out what the model does not need: Gaussians that nobody sees, SH bands that change nothing."""

from typing import TYPE_CHECKING, Any

from splatting.training.option import Option
from splatting.training.part import Error, Options, Part

if TYPE_CHECKING:
    import argparse

    from splatting.parts.last_save.trim_report import TrimReport
    from splatting.training.iteration import Iteration, Losses


def _tolerance(value: float) -> str | None:
    return None if value == -1 or value >= 0 else "at least 0, or -1"


class LastSave(Part):
    """Trims the model that is saved last, and says what that has saved."""

    name = "last_save"
    # fmt: off
    options = Options(optimisation=(
        Option("keep_unseen", False, origin="ours", topic="output",
            help="save invisible Gaussians, too. Without this the last save leaves out those that no training view "
                 "and no view between neighbours needs; training views stay the same, views from elsewhere may change"),
        Option("prune_sh", -1.0, origin="ours", check=_tolerance, topic="output",
            help="in the last save, drop the highest SH bands that change no colour (0 to 1) by more than this; 0: "
                 "drop bands that are zero throughout, -1: drop none. The sh_degree in cfg_args follows"),
    ))
    # fmt: on
    _report: "TrimReport | None" = None
    _scored = False

    @classmethod
    def wanted(cls, given: "argparse.Namespace") -> bool:
        return True

    def begin(self, run: Any, state: Any) -> None:
        self._run = run

    def measured(self, at: "Iteration", losses: "Losses") -> None:
        """Note whether the test photos are in memory at the end, so that scoring them once more costs little."""
        if at.last:
            launch = self._run.launch
            self._scored = at.scored_at is not None or self._run.opt.iterations in launch.test_iterations

    def final(self, model: Any, iteration: int) -> Any:
        from splatting.parts.last_save.trim_report import trimmed

        self._iteration = iteration
        final, self._report = trimmed(self._run, model, self._scored, iteration)
        return final

    def facts(self) -> dict[str, Any]:
        return {} if self._report is None else {"left_out": vars(self._report)}

    def records(self) -> dict[str, float]:
        return {} if self._report is None else {"gaussians_left_out": self._report.unseen}

    def ended(self, error: Error) -> None:
        if error is None and self._report is not None:
            from scene.saved_iterations import saved_ply
            from splatting.parts.last_save.trim_report import lines, saved_line

            run = self._run
            run.log.tell(saved_line(self._report, saved_ply(run.scene.model_path, self._iteration).parent))
            run.log.keep(*lines(self._report))
