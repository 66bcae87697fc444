"""The reference's names for a viewer that watches a training. This version has no viewer yet."""

import sys
from typing import Any, NoReturn

from utils.system_utils import UserError

conn: Any = None  # always None, so that training loops never serve anybody
addr: Any = None
listener: Any = None
host = "127.0.0.1"
port = 6009


def init(wish_host: str, wish_port: int) -> None:
    """Say that nobody is served. wish_host, wish_port: kept in `host` and `port`."""
    global host, port
    host, port = wish_host, wish_port
    print("this version has no viewer: nothing listens at --ip and --port", file=sys.stderr)


def try_connect() -> None:
    """Do nothing: there is nobody to accept."""


def read() -> NoReturn:
    """UserError: nobody is connected."""
    raise UserError("no viewer is connected, and this version has none; leave network_gui out while `conn` is None")


def send(message_bytes: bytes | memoryview | None, verify: str) -> NoReturn:
    """UserError: nobody is connected."""
    read()


def receive() -> NoReturn:
    """UserError: nobody is connected."""
    read()
