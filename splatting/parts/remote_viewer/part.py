"""The remote viewer of the reference (--ip, --port, --disable_viewer), by gaussian_renderer/network_gui.py."""

from typing import TYPE_CHECKING, Any

from splatting.option import Option
from splatting.part import Error, Options, Part

if TYPE_CHECKING:
    import argparse

    from splatting.training.iteration import Iteration, Losses


class RemoteViewer(Part):
    """Listens for a viewer, and serves it. Where the caller of a training listens already, it serves that one's."""

    name = "remote_viewer"
    # fmt: off
    options = Options(launch=(
        Option("ip", "127.0.0.1", help="address to listen at for the remote viewer", topic="viewers"),
        Option("port", 6009, help="port for the remote viewer, 0: any free one", topic="viewers"),
        Option("disable_viewer", False, called=True, help="open no port for the remote viewer", topic="viewers"),
    ))
    # fmt: on
    waits = True

    @classmethod
    def wanted(cls, given: "argparse.Namespace") -> bool:
        return True

    def begin(self, run: Any, state: Any) -> None:
        from gaussian_renderer import network_gui

        # No process of several can draw a view by itself.
        self.active = not run.group.several and not (run.launch.disable_viewer and network_gui.listener is None)

    def opened(self, run: Any) -> None:
        from gaussian_renderer import network_gui
        from splatting.parts.remote_viewer.serving import Serving

        if not run.launch.disable_viewer:
            run.resources.enter_context(network_gui.listening(run.launch.ip, run.launch.port))
        self._serving = Serving(run)

    def due(self, at: "Iteration") -> bool:
        return self._serving.due(at)

    def measured(self, at: "Iteration", losses: "Losses") -> None:
        self._serving.measured(at, losses)

    def ended(self, error: Error) -> None:
        self._serving.ended(error)
