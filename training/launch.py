"""Options of how a training is launched: how the ranks share it, and where viewers find it."""

import argparse

from utils.ranks.ranks import ranks
from utils.system_utils import UserError
from viewing.options import Address, add_viewer_options


def add_launch_options(parser: argparse.ArgumentParser) -> None:
    """Add --parallel, the options of the remote viewer, and those of the web page."""
    add = parser.add_argument
    add("--parallel", choices=["tiles", "views"], default="tiles",
        help="how processes that torchrun has started share the training, of which each has a part of the Gaussians; "
        "tiles: each draws a part of every view, and the result is that of one process; views: each draws a view of "
        "its own, so that an iteration shows several (default: tiles)")  # fmt: skip
    add("--ip", type=str, default="127.0.0.1", help="address to listen at for the remote viewer (default: 127.0.0.1)")
    add("--port", type=int, default=6009, help="port for the remote viewer, 0: any free one (default: 6009)")
    add("--disable_viewer", action="store_true", help="open no port for the remote viewer")
    add_viewer_options(parser)


def viewers(args: argparse.Namespace, page: Address | None) -> tuple[tuple[str, int] | None, Address | None]:
    """Where to listen for the remote viewer, and for browsers (page). UserError for a page of several ranks.

    For these, the remote viewer is not listened for, as no rank can draw a view by itself.
    """
    if not ranks().several:
        return None if args.disable_viewer else (args.ip, args.port), page
    if page is not None:
        raise UserError("--viewer needs a training of one process; leave it out, or start train.py without torchrun")
    return None, None
