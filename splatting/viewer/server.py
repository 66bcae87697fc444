"""Address of the page, and the start of a viser server behind the authorization, without its own messages."""

import contextlib
import errno
import io
import socket
import sys
import warnings
from types import ModuleType
from typing import TYPE_CHECKING, NamedTuple

from splatting.training.option import Option
from utils.system_utils import UserError

if TYPE_CHECKING:
    import viser

VISER = "viser==1.1.1"  # as setup.py names it
HOST, PORT = "127.0.0.1", 8080
HOST_OPTION = Option(
    "viewer_host", HOST, origin="ours", topic="viewers",
    help=f"address at which the page listens; others than {HOST} can be reached from outside, and then the page needs "
    "the token that is printed",
)  # fmt: skip
_TRIED = 100  # ports, from the requested one on
_TAKEN = errno.EADDRINUSE


class Address(NamedTuple):
    """Where the page listens. port 0: any that is free."""

    host: str = HOST
    port: int = PORT


def checked_address(host: str, port: int | None) -> Address | None:
    """The address that the options name, None without a port. UserError if no page can be served there."""
    if port is None:
        return None
    if not 0 <= port <= 65535:
        raise UserError(f"the page's port must be between 0 (any) and 65535, got {port}")
    _import_viser()
    _free_port(Address(host, port))
    return Address(host, port)


def serve(address: Address, label: str) -> tuple["viser.ViserServer", str]:
    """Start a server, at the next free port if the requested one is taken, and say on stderr where it listens.

    Returns the server, and its address with the token that it may need. UserError without viser, and for an
    address that cannot be listened at.
    """
    viser = _import_viser()
    from splatting.viewer.auth import Auth

    # A browser may leave at any moment, also while a frame is drawn for it.
    warnings.filterwarnings("ignore", r"Queued a \w+ on a closed connection", UserWarning)
    port = _free_port(address)
    auth = Auth(address.host)
    auth.title = label
    with auth.in_front_of_viser(), contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(address.host, port, label=label, verbose=False)
    if not auth.stands:
        stop(server)
        raise UserError(f"this release of viser cannot be guarded; pip install {VISER}")
    auth.control = server.gui._gui_input_handle_from_uuid.get
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()  # beside the picture, of which it would cover a third
    return server, _announce(address, server.get_port(), auth.token)


def stop(server: "viser.ViserServer") -> None:
    """Stop a server; browsers are told that the connection is lost."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def _import_viser() -> ModuleType:
    try:
        import viser
    except ImportError as error:
        raise UserError(f"the page needs a package ({error}); pip install {VISER}") from None
    return viser


def _free_port(address: Address) -> int:
    """The first port that can be listened at; 0 if any may be chosen. UserError if there is none."""
    host, port = address
    try:
        family, _, _, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        for tried in range(port, min(port + _TRIED, 65536)):
            with socket.socket(family) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                try:
                    probe.bind((place[0], tried, *place[2:]))
                except OSError as error:
                    if error.errno != _TAKEN:
                        raise
                    continue
                return tried
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"the page cannot listen at {host}, port {port} ({reason}); choose others") from None
    raise UserError(f"port {port} and those after it are taken; choose another one")


def _announce(address: Address, port: int, token: str | None) -> str:
    """Say where the page is, and who can reach it; its address."""
    from tqdm import tqdm  # the site reads the options above without it

    host, requested = address
    shown = socket.gethostname() if host in ("0.0.0.0", "::", "") else f"[{host}]" if ":" in host else host
    url = f"http://{shown}:{port}/" + ("" if token is None else f"?token={token}")
    taken = f" (port {requested} is taken)" if requested not in (0, port) else ""
    tqdm.write(f"viewer: {url}{taken}", file=sys.stderr)  # a progress bar may be there
    if token is not None:
        tqdm.write(
            f"warning: every machine that reaches {host} by the network can ask for this page; whoever has the address "
            "with its token sees the scene and its photos and controls the process, and nothing is encrypted",
            file=sys.stderr,
        )
    return url
