"""Authorization of connections: who may come, how many, and which of their messages viser gets.

viser sets whatever attribute of a control a message names, keeps files that nobody asked for, and opens as many
connections as come. Each of these could end a training.
"""

import asyncio
import contextlib
import gzip
import hmac
import html
import http
import logging
import math
import secrets
from collections.abc import Callable, Iterator
from functools import partial
from ipaddress import ip_address
from typing import Annotated, Any
from urllib.parse import parse_qs, urlsplit

import msgspec
import websockets.asyncio.server as websocket_server
from websockets.asyncio.connection import Connection
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response
from websockets.protocol import State

MOST = 64  # connections at a time, those that have not said anything yet among them
LARGEST = 1 << 16  # bytes of a message; a browser's have some hundred
UNREAD = 8 << 20  # bytes that may wait for a browser to read them when more are to be sent; a frame has fewer
PATIENCE = 60.0  # seconds in which a browser has to read what was sent
_TITLE = b"<title>Viser</title>"  # of viser's document
_GOODBYE = 0.5  # seconds that the end waits for a browser that does not answer
_LEAST_UP = 1e-6  # length of a camera's upward direction; without one, viser cannot move the camera
_LARGEST_NUMBER = 2**53  # of a control. Up to it, floats are exact, and its whole numbers can be sent to others
_LOCAL_NAME = "localhost"
_HEADERS = {
    "Referrer-Policy": "no-referrer",  # the address may hold the token
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}

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


def is_loopback(host: str) -> bool:
    """Whether only programs of this machine reach an address."""
    try:
        return host == _LOCAL_NAME or ip_address(host).is_loopback
    except ValueError:
        return False


class _Checked(ServerConnection):
    """A connection that counts, that hands on only what is accepted, and that ends if its browser does not read."""

    def __init__(self, owner: "Auth", *given: Any, **options: Any) -> None:
        super().__init__(*given, **options)
        self.owner = owner

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


class Auth:
    """Refuses every request, for a file or for a websocket, that may not come in, and connections beyond MOST.

    A page of another origin may not ask. On a loopback address, the request must name a loopback host. So no page that
    is open in the user's browser reaches this one, not even through a name that it leads to 127.0.0.1. On other
    addresses, a random `token` is needed: in the address (?token=), or in the cookie that is set by the first answer.

    present: the connections, in the order in which they came. control: as for `is_accepted`. stands: whether viser has
    asked for requests to be checked. title: of the document.
    """

    def __init__(self, host: str) -> None:
        self.token = None if is_loopback(host) else secrets.token_urlsafe(32)
        self.present: dict[_Checked, None] = {}
        self.control: Callable[[str], Any] = lambda uuid: None
        self.stands = False
        self.title = ""

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

    def refusal(self, request: Request) -> str | None:
        """Why a request is refused, None if it may come in."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or len(origins) > 1:
            return "the request must name one host"
        if origins and urlsplit(origins[0]).netloc != hosts[0]:
            return "pages of other origins may not ask"
        if self.token is not None:
            return None if self._has_token(request, hosts[0]) else "the address needs the token that was printed"
        return None if is_loopback(_place(hosts[0])[0]) else "this page is served to this machine alone"

    def _has_token(self, request: Request, host: str) -> bool:
        given = parse_qs(urlsplit(request.path).query).get("token", [])
        for part in ";".join(request.headers.get_all("Cookie")).split(";"):
            name, _, value = part.strip().partition("=")
            given += [value] * (name == _cookie(host))
        return any(hmac.compare_digest(one.encode(), self.token.encode()) for one in given)

    def answer(self, connection: Any, request: Request, further: Callable[[Any, Request], Response | None]) -> Any:
        """The answer to a request: a refusal, or what viser answers. None: a websocket may be opened."""
        try:
            reason = self.refusal(request)
        except ValueError:  # of a malformed address
            reason = "the request cannot be read"
        if reason is not None:
            return connection.respond(http.HTTPStatus.FORBIDDEN, f"{reason}\n")
        response = further(connection, request)
        if response is not None:
            self._entitle(response)
            host = request.headers["Host"]
            response.headers.update(_HEADERS | {"Content-Security-Policy": _policy(host)})
            if self.token is not None:
                response.headers["Set-Cookie"] = f"{_cookie(host)}={self.token}; HttpOnly; SameSite=Strict; Path=/"
        return response

    def _entitle(self, response: Response) -> None:
        """Give the document, which is called after viser, the page's own title."""
        if not response.headers.get("Content-Type", "").startswith("text/html"):
            return
        packed = response.headers.get("Content-Encoding") == "gzip"
        body = gzip.decompress(response.body) if packed else response.body
        body = body.replace(_TITLE, f"<title>{html.escape(self.title)}</title>".encode(), 1)
        response.body = gzip.compress(body, 1) if packed else body
        del response.headers["Content-Length"]
        response.headers["Content-Length"] = str(len(response.body))

    @contextlib.contextmanager
    def in_front_of_viser(self) -> Iterator[None]:
        """Inside, a viser server that starts is guarded by it. `stands` tells whether one did."""
        plain = websocket_server.serve
        logger = logging.getLogger(__name__)
        logger.addFilter(_is_worth_a_line)  # the same one counts once

        def serve(*arguments: Any, process_request: Callable, **options: Any) -> Any:
            self.stands = True
            own = {
                "create_connection": partial(_Checked, self),
                "process_request": lambda connection, request: self.answer(connection, request, process_request),
                "logger": logger,
                "max_size": LARGEST,
                "close_timeout": _GOODBYE,
            }
            return plain(*arguments, **options | own)

        websocket_server.serve = serve
        try:
            yield
        finally:
            websocket_server.serve = plain


def _cookie(host: str) -> str:
    """A name for each port, because browsers send a cookie to all ports of a host."""
    return f"viewer_token_{_place(host)[1]}"


def _place(host: str) -> tuple[str, int]:
    """Name and port of a Host header. ValueError if it is malformed."""
    parts = urlsplit(f"//{host}")
    return parts.hostname or "", parts.port or 80


def _policy(host: str) -> str:
    """The browser itself keeps the page from asking anybody else: Content Security Policy, level 3."""
    name, port = _place(host)
    place = f"{f'[{name}]' if ':' in name else name}:{port}"
    return (
        "default-src 'self' data: blob: 'unsafe-inline' 'unsafe-eval'; "
        f"connect-src 'self' data: blob: ws://{place} wss://{place}; "
        "form-action 'none'; base-uri 'none'; frame-ancestors 'self'"
    )
