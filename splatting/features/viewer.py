"""A web page that shows the training and controls it (--viewer)."""

import argparse
from typing import TYPE_CHECKING, Any

from groundwork.applications import VIEWER_PORT, application
from splatting.option import MOST_NEEDED, Option
from splatting.part import Error, Needs, Options, Part
from utils.system_utils import UserError

if TYPE_CHECKING:
    from splatting.iteration import Iteration


class _Port(Option):
    """An option whose value may be left out."""

    def add_to(self, group: argparse._ActionsContainer, sentinel: bool) -> None:
        words = {"type": int, "nargs": "?", "const": VIEWER_PORT, "metavar": "PORT", "help": self.help}
        group.add_argument(f"--{self.name}", **words).topic = self.topic  # type: ignore[arg-type, attr-defined]


class Viewer(Part):
    """Serves the page. It comes last, so that a paused training has done all else that belongs to its iteration."""

    name = "viewer"
    # fmt: off
    options = Options(launch=(
        _Port("viewer", None, origin="ours", topic=MOST_NEEDED,
            help=f"serve a web page that shows and controls the training, at this port or {VIEWER_PORT}; it stays open "
                 "afterwards (default: no page)"),
        Option("paused", False, origin="ours", topic="viewers",
            help="with --viewer: wait after the first iteration until the page lets the training go on"),
    ))
    # fmt: on
    needs = Needs(ranks=False)
    told_last = True

    @classmethod
    def wanted(cls, given: argparse.Namespace) -> bool:
        return getattr(given, "viewer", None) is not None or getattr(given, "paused", False)

    def check(self, run: Any, state: Any) -> None:
        if run.launch.viewer is None:
            raise UserError("--paused needs --viewer, whose page lets the training go on")
        application("viewer", "server").check_port(run.launch.viewer)

    def opened(self, run: Any) -> None:
        self._page = application("viewer", "training_page").TrainingPage(run)
        run.resources.callback(self._page.close)

    def due(self, at: "Iteration") -> bool:
        return self._page.due(at)

    def stepped(self, at: "Iteration") -> None:
        self._page.stepped(at)

    def ended(self, error: Error) -> None:
        self._page.ended(error)
