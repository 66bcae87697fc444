"""Authorization in front of the page: which requests viser gets to see."""

import hmac
import http
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from ipaddress import ip_address
from typing import Any
from urllib.parse import parse_qs, urlsplit

import websockets.asyncio.server as websocket_server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from splatting.viewer.connections import Connections

_LOCAL_NAME = "localhost"
_HEADERS = {
    "Referrer-Policy": "no-referrer",  # the address may hold the token
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


def is_loopback(host: str) -> bool:
    """Whether only programs of this machine reach an address."""
    try:
        return host == _LOCAL_NAME or ip_address(host).is_loopback
    except ValueError:
        return False


class Auth:
    """Refuses every request, for a file or for a websocket, that may not come in.

    A page of another origin may not ask. On a loopback address, the request must name a loopback host. So no page that
    is open in the user's browser reaches this one, not even through a name that it leads to 127.0.0.1. On other
    addresses, a random `token` is needed: in the address (?token=), or in the cookie that is set by the first answer.
    """

    def __init__(self, host: str) -> None:
        self.token = None if is_loopback(host) else secrets.token_urlsafe(32)
        self.connections = Connections()
        self.stands = False  # whether viser has asked for requests to be checked

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
            body = f"{reason}\n".encode()
            kind = Headers({"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))})
            return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", kind, body)
        response = further(connection, request)
        if response is not None:
            host = request.headers["Host"]
            for name, value in (_HEADERS | {"Content-Security-Policy": _policy(host)}).items():
                response.headers[name] = value
            if self.token is not None:
                response.headers["Set-Cookie"] = f"{_cookie(host)}={self.token}; HttpOnly; SameSite=Strict; Path=/"
        return response

    @contextmanager
    def in_front_of_viser(self) -> Iterator[None]:
        """Inside, a viser server that starts is guarded by it. `stands` tells whether one did."""
        plain = websocket_server.serve

        def serve(*arguments: Any, process_request: Callable, **options: Any) -> Any:
            self.stands = True
            own = {"process_request": lambda connection, request: self.answer(connection, request, process_request)}
            return plain(*arguments, **options | self.connections.options() | own)

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
