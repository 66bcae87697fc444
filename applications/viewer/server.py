"""Port of the page, and the start of a viser server on this machine alone, without its own messages."""

import contextlib
import errno
import html
import http
import io
import re
import socket
import sys
import warnings
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import TYPE_CHECKING, Any

from utils.system_utils import UserError

if TYPE_CHECKING:
    import viser
    from websockets.http11 import Request

VISER = "viser==1.1.1"  # as setup.py names it
HOST = "127.0.0.1"
_TRIED = 100  # ports, from the requested one on
_HERE = re.compile(r"(localhost|127\.0\.0\.1|\[::1\])(:\d+)?")
_TITLE = b"<title>Viser</title>"  # of viser's document
_GOODBYE = 0.5  # seconds that the end waits for a browser that does not answer


def check_port(port: int | None) -> None:
    """Raise a UserError if no page can be served at this port, 0: any. None: no page is asked for."""
    if port is not None:
        if not 0 <= port <= 65535:
            raise UserError(f"the page's port must be between 0 (any) and 65535, got {port}")
        _import_viser()
        _find_free_port(port)


def serve(port: int, label: str) -> tuple["viser.ViserServer", str]:
    """Start a server, at the next free port if the requested one is taken, and say on stderr where it listens.

    Returns the server and its address. label: of the page. UserError without viser, or a free port.
    """
    viser = _import_viser()
    # A browser may leave at any moment, also while a frame is drawn for it.
    warnings.filterwarnings("ignore", r"Queued a \w+ on a closed connection", UserWarning)
    free = _find_free_port(port)
    with _guard_server(label) as started, contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(HOST, free, label=label, verbose=False)
    if not started:
        stop(server)
        raise UserError(f"this release of viser cannot be guarded; pip install {VISER}")
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()  # beside the picture, of which it would cover a third
    return server, _announce_address(port, server.get_port())


@contextlib.contextmanager
def _guard_server(title: str) -> Iterator[list[Any]]:
    """Let a viser server that starts inside answer only requests that pass `is_own`. Yields the servers.

    title: of the document, which is called after viser.
    """
    from websockets.asyncio import server as websocket_server

    plain, started = websocket_server.serve, []

    def serve(*arguments: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        """Start the server as websockets does, but with `answer` before its own handler."""

        def answer(connection: Any, request: "Request") -> Any:
            """Refuse a request that is not the page's own, and give the document its title."""
            if not is_own(request):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "this page is served to its own machine alone\n")
            request.headers.pop("Accept-Encoding", None)  # or the document comes compressed
            response = process_request(connection, request)
            if response is not None and _TITLE in (response.body or b""):
                response.body = response.body.replace(_TITLE, f"<title>{html.escape(title)}</title>".encode(), 1)
                del response.headers["Content-Length"]
                response.headers["Content-Length"] = str(len(response.body))
            return response

        started.append(plain(*arguments, **options | {"process_request": answer, "close_timeout": _GOODBYE}))
        return started[-1]

    websocket_server.serve = serve
    try:
        yield started
    finally:
        websocket_server.serve = plain


def is_own(request: "Request") -> bool:
    """Tell if a request comes from the page itself, or from a program of this machine.

    Every site that is open in the user's browser may ask 127.0.0.1 for a websocket, also through a name of its own
    that leads there, and could stop the training. The browser names the site in Origin, and the name in Host. The port
    may be that of a tunnel.
    """
    hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
    return len(hosts) == 1 and bool(_HERE.fullmatch(hosts[0])) and origins in ([], [f"http://{hosts[0]}"])


def stop(server: "viser.ViserServer") -> None:
    """Stop a server; browsers are told that the connection is lost."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def _import_viser() -> ModuleType:
    """Import viser. UserError if it is not installed."""
    try:
        import viser
    except ImportError as error:
        raise UserError(f"the page needs a package ({error}); pip install {VISER}") from None
    return viser


def _find_free_port(port: int) -> int:
    """The first port that can be listened at; 0 if any may be chosen. UserError if there is none."""
    for tried in range(port, min(port + _TRIED, 65536)):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, tried))
            except OSError as error:
                if error.errno == errno.EADDRINUSE:
                    continue
                raise UserError(f"port {tried} cannot be listened at ({error.strerror}); choose another one") from None
            return tried
    raise UserError(f"port {port} and those after it are taken; choose another one")


def _announce_address(requested: int, port: int) -> str:
    """Print and return the address of the page."""
    from tqdm import tqdm  # the site reads the options of parts without it

    url = f"http://{HOST}:{port}/"
    taken = f" (port {requested} is taken)" if requested not in (0, port) else ""
    tqdm.write(f"viewer: {url}{taken}", file=sys.stderr)  # a progress bar may be there
    return url
