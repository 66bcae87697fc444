"""Messages over a viewer's connection, with limits of time and length so that no viewer can block training for ever."""

import contextlib
import math
import select
import socket
import struct
import time
from collections.abc import Iterator

SILENCE = 1.0  # seconds without a byte, within a message either way
LONGEST = 10.0  # seconds of a message in all
LARGEST = 1 << 16  # bytes of a request; the viewer's have about 1,000
_PART = 1 << 20  # bytes handed to the system at once
_LOOK = 0.5  # seconds of a wait without a look at signals; one that comes just before a wait does not end it


# The system asks a silent viewer for a sign of life, so that one whose machine is gone does not hold a paused training.
_KEEP_ALIVE = {"TCP_KEEPIDLE": 10, "TCP_KEEPINTVL": 5, "TCP_KEEPCNT": 4}  # seconds, seconds, times; not on all systems


class ViewerLost(Exception):
    """An error that ends a connection. Its text is the reason."""


class ViewerLeft(ViewerLost):
    """The error for a connection that the viewer has closed between two messages."""


def set_up(conn: socket.socket) -> None:
    """Set a new connection's options: short messages go out at once, and one whose other end is gone ends."""
    conn.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    conn.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in _KEEP_ALIVE.items():
        if hasattr(socket, name):
            conn.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


def readable(sock: socket.socket, seconds: float | None = 0.0) -> bool:
    """Tell whether bytes, the connection's end or, at a listener, a new connection arrive within `seconds`.

    seconds: None waits without end. Without a wait, the call takes less than a microsecond.
    """
    left = math.inf if seconds is None else seconds
    while left > _LOOK:
        if _wait_for_data(sock, _LOOK):
            return True
        left -= _LOOK
    return _wait_for_data(sock, left)


def _wait_for_data(sock: socket.socket, seconds: float) -> bool:
    """Wait at most `seconds` for data on a socket, and tell whether there are any."""
    if not hasattr(select, "poll"):
        return bool(select.select([sock], [], [], seconds)[0])
    poll = select.poll()
    poll.register(sock, select.POLLIN)
    return bool(poll.poll(1000 * seconds))


def receive_message(conn: socket.socket) -> bytes:
    """Receive the bytes of a message after its length. ViewerLeft if none comes, ViewerLost after a part of one."""
    end = time.monotonic() + LONGEST
    head = _receive(conn, 4, end)
    if not head:
        raise ViewerLeft("it left")
    length = struct.unpack("<I", head)[0] if len(head) == 4 else 0
    if length > LARGEST:
        raise ViewerLost(f"it announced a message of {length:,} bytes, and a request has at most {LARGEST:,}")
    text = _receive(conn, length, end)
    if len(head) < 4 or len(text) < length:
        raise ViewerLost("it left in the middle of a message")
    return text


def send_message(conn: socket.socket, frame: bytes | memoryview, text: bytes) -> None:
    """Send a frame without its length, then a text after its length. ViewerLost if the viewer does not take them."""
    end = time.monotonic() + LONGEST
    _send(conn, frame, end)
    _send(conn, struct.pack("<I", len(text)) + text, end)


def _receive(conn: socket.socket, count: int, end: float) -> bytes:
    """Receive `count` bytes, or fewer if the connection ends before."""
    received = bytearray()
    while len(received) < count:
        with _limit_time(conn, end):
            part = conn.recv(count - len(received))
        if not part:
            break
        received += part
    return bytes(received)


def _send(conn: socket.socket, data: bytes | memoryview, end: float) -> None:
    rest = memoryview(data).cast("B")
    while rest:
        with _limit_time(conn, end):
            rest = rest[conn.send(rest[:_PART]) :]


@contextlib.contextmanager
def _limit_time(conn: socket.socket, end: float) -> Iterator[None]:
    """Let a call in the block take SILENCE seconds, but not past the time `end`; raise a failure as ViewerLost."""
    try:
        left = end - time.monotonic()
        if left <= 0:
            raise TimeoutError
        conn.settimeout(min(SILENCE, left))
        yield
    except TimeoutError as error:
        silent = f"it was silent for {SILENCE:g} s in the middle of a message"
        raise ViewerLost(f"its message took more than {LONGEST:g} s" if time.monotonic() >= end else silent) from error
    except OSError as error:
        raise ViewerLost(error.strerror or str(error)) from error
