"""The options that say where the page listens."""

import argparse
from typing import NamedTuple

HOST, PORT = "127.0.0.1", 8080


class Address(NamedTuple):
    """Where the page listens. port 0: any that is free."""

    host: str = HOST
    port: int = PORT


def add_host_option(parser: argparse.ArgumentParser) -> None:
    """--viewer_host."""
    parser.add_argument(
        "--viewer_host", type=str, default=HOST, metavar="HOST",
        help=f"address at which the page listens; others than {HOST} can be reached from outside, and then the page "
        f"needs the token that is printed (default: {HOST})",
    )  # fmt: skip


def add_viewer_options(parser: argparse.ArgumentParser) -> None:
    """--viewer and --viewer_host of train.py."""
    parser.add_argument(
        "--viewer", type=int, nargs="?", const=PORT, default=None, metavar="PORT",
        help=f"serve a web page that shows the training and controls it, at this port or {PORT} (default: no page)",
    )  # fmt: skip
    add_host_option(parser)
