"""A web page that shows the training and controls it (--viewer)."""

import argparse
from typing import Any

from groundwork.applications import application
from splatting.iteration import Iteration
from splatting.part import Error, Needs, Part
from utils.system_utils import UserError


class Viewer(Part):
    """Serves the page. It comes last, so that a paused training has done all else that belongs to its iteration."""

    name = "viewer"
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

    def due(self, at: Iteration) -> bool:
        return self._page.due(at)

    def stepped(self, at: Iteration) -> None:
        self._page.stepped(at)

    def ended(self, error: Error) -> None:
        self._page.ended(error)
