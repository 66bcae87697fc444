"""The remote viewer's side of a training: a socket that listens, one viewer, its requests and their answers.

The names are the reference's, so that training loops written for the reference work. `conn` is the viewer's socket,
None while nobody is connected; a loop may set it to None to drop the viewer. The protocol has no password.
"""

import contextlib
import errno
import os
import socket
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from tqdm import tqdm

from gaussian_renderer.network_message import BadMessage, Request, decode, parse
from gaussian_renderer.network_transfer import ViewerLeft, ViewerLost, readable, receive_message, send_message, set_up
from groundwork.host.machine import compute_device
from scene.cameras import MiniCam
from utils.system_utils import UserError

PATIENCE = 30.0  # seconds that `read` waits for a viewer that lets training go on, or has not asked for anything yet
FIRST = 10.0  # seconds after which `has_request` ends a connection that has not asked for anything

conn: socket.socket | None = None
addr: Any = None
listener: socket.socket | None = None
host = "127.0.0.1"
port = 6009


@dataclass
class _Viewer:
    """State of the connected viewer, from its requests so far."""

    since: float = 0.0
    has_asked: bool = False
    train: bool = True
    keep_alive: bool = False


_viewer = _Viewer()


def init(wish_host: str, wish_port: int, chosen: bool = True) -> None:
    """Listen at an address; port 0: any free one, which is printed. A failure is one warning on stderr.

    `host` and `port` become the wish, and `port` the one that was found. chosen: whether the user chose the address; if
    not, a port that is taken, as in the second of two trainings, causes no warning.
    """
    global host, port, listener
    close()
    host, port = wish_host, wish_port
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        listener = socket.create_server((host, port), family=family)
        listener.setblocking(False)
    except (OSError, OverflowError) as error:
        if not chosen and getattr(error, "errno", None) == errno.EADDRINUSE:
            return
        reason = str(getattr(error, "strerror", None) or error).partition(" (")[0]  # it would name the address again
        print(
            f"warning: cannot listen at {host}:{port} ({reason}), which concerns only the viewer of the reference "
            "implementation (SIBR); give --disable_viewer to silence this, or --port 0 for any free port",
            file=sys.stderr,
        )
        return
    port = listener.getsockname()[1]
    if wish_port == 0:
        print(f"A viewer can connect to {host}:{port}")


def close() -> None:
    """Disconnect the viewer, and stop listening."""
    global listener
    disconnect()
    if listener is not None:
        listener.close()
        listener = None


@contextlib.contextmanager
def listening(wish_host: str, wish_port: int, chosen: bool = True) -> Iterator[None]:
    """Listen at an address (`init`) inside the block."""
    init(wish_host, wish_port, chosen)
    try:
        yield
    finally:
        close()


def try_connect() -> None:
    """Accept a viewer if one is waiting. Costs about a microsecond if none is."""
    global conn, addr, _viewer
    if listener is None or not readable(listener):
        return
    try:
        accepted, addr = listener.accept()
        set_up(accepted)
    except OSError:  # it has gone already
        return
    conn = accepted
    _viewer = _Viewer(since=time.monotonic())
    tqdm.write(f"viewer {_name_viewer()} connected", file=sys.stdout)


def has_request(seconds: float = 0.0) -> bool:
    """Tell whether the viewer sends a request, or leaves, within `seconds`; False while nobody is connected.

    A viewer that has sent nothing after FIRST seconds is disconnected.
    """
    if conn is None:
        return False
    if readable(conn, seconds):
        return True
    if not _viewer.has_asked and time.monotonic() - _viewer.since > FIRST:
        disconnect(f"it has not asked for anything for {FIRST:g} s")
    return False


def wants_wait(last: bool) -> bool:
    """Tell whether the viewer wants training to wait. last: in the last iteration, when keep_alive waits, too."""
    return conn is not None and not (_viewer.train and not (last and _viewer.keep_alive))


def read() -> dict[str, Any]:
    """Wait for the viewer's next message and return its JSON object, unchecked.

    ViewerLost, with a line on stderr, once the connection has ended; UserError while nobody is connected.
    """
    with _drop_viewer_on_error():
        if not readable(conn, None if wants_wait(last=False) else PATIENCE):
            raise ViewerLost(f"it has sent nothing for {PATIENCE:g} s")
        return decode(receive_message(conn))


def receive_request() -> Request | None:
    """Wait for the viewer's next request; None for a request without a frame. Errors as in `read`."""
    message = read()
    with _drop_viewer_on_error():
        request = parse(message)
    _viewer.has_asked = True
    if request is not None:
        _viewer.train, _viewer.keep_alive = request.train, request.keep_alive
    return request


def receive() -> tuple[MiniCam | None, bool | None, bool | None, bool | None, bool | None, float | None]:
    """The next request as camera, train, shs_python, rot_scale_python, keep_alive and scaling_modifier.

    All are None in a request without a frame. Errors as in `read`.
    """
    request = receive_request()
    if request is None:
        return None, None, None, None, None, None
    flags = request.train, request.shs_python, request.rot_scale_python, request.keep_alive
    return request.camera(compute_device()), *flags, request.scaling_modifier


def send(message_bytes: bytes | memoryview | None, verify: str) -> None:
    """Answer a request: the frame's bytes (H, W, 3), None without one, and the dataset's path. Errors as in `read`."""
    with _drop_viewer_on_error():
        send_message(conn, b"" if message_bytes is None else message_bytes, os.fsencode(verify))


def disconnect(fault: str | None = None) -> None:
    """Disconnect the viewer, with a message. fault: the reason, if it is the viewer's fault."""
    global conn, addr
    if conn is None:
        return
    name = _name_viewer()
    conn.close()
    conn = addr = None
    if fault is None:
        tqdm.write(f"viewer {name} disconnected", file=sys.stdout)
    else:
        tqdm.write(f"viewer {name} is disconnected: {fault}", file=sys.stderr)


@contextlib.contextmanager
def _drop_viewer_on_error() -> Iterator[None]:
    """Disconnect the viewer at an error of its own inside the block."""
    if conn is None:
        raise UserError("no viewer is connected; call network_gui.try_connect() until `conn` is not None")
    try:
        yield
    except ViewerLeft:
        disconnect()
        raise
    except ViewerLost as error:
        disconnect(str(error))
        raise
    except BadMessage as error:
        disconnect(str(error))
        raise ViewerLost(str(error)) from error


def _name_viewer() -> str:
    return ":".join(map(str, addr[:2])) if addr else "without an address"
