"""Connections of browsers: how many there may be, and which of their messages viser gets.

viser sets whatever attribute of a control a message names, keeps files that nobody asked for, and opens as many
connections as come. Each of these could end a training.
"""

import asyncio
import contextlib
import logging
import math
from collections.abc import Callable
from typing import Annotated, Any

import msgspec
from websockets.asyncio.connection import Connection
from websockets.asyncio.server import ServerConnection
from websockets.protocol import State

MOST = 64  # connections at a time, those that have not said anything yet among them
LARGEST = 1 << 16  # bytes of a message; a browser's have some hundred
UNREAD = 8 << 20  # bytes that may wait for a browser to read them when more are to be sent; a frame has fewer
PATIENCE = 60.0  # seconds in which a browser has to read what was sent
_GOODBYE = 0.5  # seconds that the end waits for a browser that does not answer
_LEAST_UP = 1e-6  # length of a camera's upward direction; without one, viser cannot move the camera
_LARGEST_NUMBER = 2**53  # of a control. Up to it, floats are exact, and its whole numbers can be sent to others

_Number = Annotated[float, msgspec.Meta(ge=-1e18, le=1e18)]  # finite, and so is its square in float32
_Three = tuple[_Number, _Number, _Number]


class _Camera(msgspec.Struct, forbid_unknown_fields=True, tag_field="type", tag="ViewerCameraMessage"):
    wxyz: tuple[_Number, _Number, _Number, _Number]
    position: _Three
    fov: _Number
    near: _Number
    far: _Number
    image_height: _Number
    image_width: _Number
    look_at: _Three
    up_direction: _Three


class _Value(msgspec.Struct, forbid_unknown_fields=True):
    value: Any


class _Control(msgspec.Struct, forbid_unknown_fields=True, tag_field="type", tag="GuiUpdateMessage"):
    uuid: str
    updates: _Value


class _Click(msgspec.Struct, forbid_unknown_fields=True, tag_field="type", tag="SceneNodeClickMessage"):
    name: str
    instance_index: int | None
    ray_origin: _Three
    ray_direction: _Three
    screen_pos: tuple[_Number, _Number]
    modifier: str | None
    owner: str = ""


_DECODER = msgspec.msgpack.Decoder(_Camera | _Control | _Click)


def is_accepted(message: bytes | str, control: Callable[[str], Any]) -> bool:
    """Whether viser may get a message: a camera that stands upright, a click, or a value of its control's kind.

    control: viser's handle of the control with an id, or None.
    """
    try:
        decoded = _DECODER.decode(message)
    except (msgspec.MsgspecError, TypeError, ValueError, RecursionError):
        return False
    if isinstance(decoded, _Camera):
        return math.hypot(*decoded.up_direction) > _LEAST_UP
    if isinstance(decoded, _Click):
        return True
    handle = control(decoded.uuid)
    return handle is not None and not handle.disabled and _has_kind(decoded.updates.value, handle.value)


def _has_kind(value: Any, present: Any) -> bool:
    """Whether a value is of the kind of a control's present one; numbers are bounded, vectors have its length."""
    if isinstance(present, bool | str):
        return isinstance(value, type(present))
    if isinstance(present, tuple):
        return isinstance(value, list) and len(value) == len(present) and all(map(_has_kind, value, present))
    return type(value) in (int, float) and abs(value) <= _LARGEST_NUMBER


class Connections:
    """The connections of one server, `present` in the order in which they came. control: as for `is_accepted`."""

    def __init__(self) -> None:
        self.present: dict[_Checked, None] = {}
        self.control: Callable[[str], Any] = lambda uuid: None

    def options(self) -> dict[str, Any]:
        """Options of `websockets.asyncio.server.serve` that put its connections into this object's hands."""
        logger = logging.getLogger(__name__)
        logger.addFilter(_is_worth_a_line)  # the same one counts once
        limits = {"max_size": LARGEST, "close_timeout": _GOODBYE}
        return {"create_connection": self._create, "logger": logger, **limits}

    def _create(self, *given: Any, **options: Any) -> ServerConnection:
        connection = _Checked(*given, **options)
        connection.owner = self
        return connection

    def has_room(self) -> bool:
        """Whether one more connection may come. For it, the oldest goes that has opened no websocket.

        One that has not even asked for anything goes before those that have.
        """
        if len(self.present) < MOST:
            return True
        unfinished = [one for one in self.present if one.state is not State.OPEN]
        if unfinished:
            oldest = min(unfinished, key=lambda one: one.request is not None)
            del self.present[oldest]
            oldest.transport.abort()
        return bool(unfinished)


class _Checked(ServerConnection):
    """A connection that counts, that hands on only what is accepted, and that ends if its browser does not read."""

    owner: Connections

    def connection_made(self, transport: Any) -> None:
        if self.owner.has_room():
            self.owner.present[self] = None
            super().connection_made(transport)
        else:
            Connection.connection_made(self, transport)  # without the task that would read a request
            transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self.owner.present.pop(self, None)
        super().connection_lost(exc)

    def send_data(self) -> None:
        for data in self.protocol.data_to_send():
            if self.transport.get_write_buffer_size() > UNREAD:
                self.transport.abort()
            if self.transport.is_closing():
                return  # asyncio would log each further write
            if data:
                self.transport.write(data)
            else:
                with contextlib.suppress(OSError):
                    self.transport.write_eof()

    async def drain(self) -> None:
        # Not for ever: also the ping that would find out that nobody is there waits here.
        await asyncio.wait_for(super().drain(), PATIENCE)

    async def recv(self, decode: bool | None = None) -> bytes | str:
        while True:
            message = await super().recv(decode)
            if is_accepted(message, self.owner.control):
                return message


def _is_worth_a_line(record: logging.LogRecord) -> bool:
    """Whether to print what the server logs: not that somebody has sent nonsense, or nothing."""
    return record.getMessage() != "opening handshake failed"
