"""Messages and connections that browsers, and programs that pretend to be one, may have with the viewer's page."""

import math
import secrets
import select
import socket
import time
from types import SimpleNamespace

import pytest

viser = pytest.importorskip("viser", reason="viser is not installed: pip install '.[viewer]'")

import msgspec  # noqa: E402
from viser_client import Client, get  # noqa: E402
from waiting import LIMIT, wait_for  # noqa: E402
from websockets.asyncio.server import serve  # noqa: E402
from websockets.exceptions import ConnectionClosed  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

from splatting.viewer import connections  # noqa: E402
from splatting.viewer import server as servers  # noqa: E402
from splatting.viewer.connections import is_accepted  # noqa: E402
from splatting.viewer.options import Address  # noqa: E402

VALUES = {
    "text": "a", "number": 1.0, "whole": 1, "switch": False, "vector": (0.0, 0.0, 0.0), "nested": ((0, 1), (2, 3)),
}  # fmt: skip
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [0, 0.5, 0], "fov": 0.8, "near": 0.01, "far": 9,
    "image_height": 64, "image_width": 96, "look_at": [0, 0, 0], "up_direction": [0, -1, 0],
}  # fmt: skip
CLICK = {
    "type": "SceneNodeClickMessage", "name": "/cameras/0", "instance_index": None, "ray_origin": [0, 0, 0],
    "ray_direction": [0, 0, 1], "screen_pos": [0.5, 0.5], "modifier": None, "owner": "",
}  # fmt: skip


def _control(uuid: str) -> SimpleNamespace | None:
    return SimpleNamespace(value=VALUES[uuid], disabled=False) if uuid in VALUES else None


def _update(uuid: object, value: object, **more: object) -> dict[str, object]:
    return {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value} | more}


@pytest.mark.parametrize(
    "message",
    [
        CAMERA, CLICK, _update("text", "b"), _update("number", 2), _update("whole", 3), _update("switch", True),
        _update("vector", [1, 2.5, 3]), _update("whole", -(2**53)), _update("nested", [[1, 2], [2**53, 4]]),
    ],
)  # fmt: skip
def test_what_a_browser_sends_is_heard(message):
    assert is_accepted(msgspec.msgpack.encode(message), _control)


@pytest.mark.parametrize(
    "message",
    [
        *[CAMERA | wrong for wrong in (
            {"position": [0.0, 0.0]}, {"position": "abc"}, {"position": [[1], [2], [3]]}, {"wxyz": [1.0, 0.0, 0.0]},
            {"position": [math.nan] * 3}, {"position": [1e300, 0, 0]}, {"fov": math.inf}, {"fov": None},
            {"image_width": math.inf}, {"image_width": "x"}, {"up_direction": [1]}, {"more": 1},
            {"up_direction": [0, 0, 0]}, {"up_direction": [0, 1e-200, 0]},
        )],
        CLICK | {"name": 5}, CLICK | {"ray_origin": []},
        *[_update(uuid, value) for uuid, value in (
            ("text", 1), ("text", ["a"]), ("number", "1"), ("number", math.nan), ("number", math.inf), ("number", True),
            ("whole", [1]), ("switch", 1), ("switch", "yes"), ("vector", []), ("vector", [1, 2]), ("vector", [1] * 4),
            ("vector", "123"), ("vector", [1, 2, math.nan]), ("vector", 1), ("none", 1), (5, 1), ("number", 1e300),
            ("whole", 1e300), ("whole", 2**53 + 1), ("whole", -(2**63)), ("vector", [1e300, 0, 0]),
            ("nested", [[1, 2], [1e300, 4]]), ("nested", [1, 2]),
        )],
        _update("number", 1, removed=True), _update("number", 1) | {"updates": {"update_cb": [5]}},
        _update("number", 1) | {"updates": 5}, {"type": "ShareUrlRequest"}, {"type": 5}, {"type": "Message"}, {}, [], 5,
        {"type": "FileTransferStartUpload", "source_component_uuid": "number", "transfer_uuid": "t", "filename": "f",
         "mime_type": "m", "part_count": 1, "size_bytes": 3},
    ],
)  # fmt: skip
def test_nothing_else_is_heard(message):
    assert not is_accepted(msgspec.msgpack.encode(message), _control)


def test_what_is_no_message_is_not_heard_and_what_only_shows_something_takes_no_value():
    for raw in (b"", b"\xff" * 10, "text", b"\x80", b"\x91" * 60_000, b"a" * 100):
        assert not is_accepted(raw, _control), raw[:20]
    message = msgspec.msgpack.encode(_update("text", "b"))
    assert not is_accepted(message, lambda uuid: SimpleNamespace(value="a", disabled=True))


@pytest.fixture(scope="module")
def served():
    made = servers.serve(Address("127.0.0.1", 0), "test")
    yield made
    servers.stop(made.server)


def _attack(client: Client, uuid: str) -> None:
    """All that once made viser's controls raise in the thread that trains, and a wish for a tunnel to the outside."""
    for update in ({"update_cb": [5]}, {"sync_cb": 5}, {"gui_api": 5}, {"removed": True}, {"uuid": 5}):
        client.send("GuiUpdateMessage", uuid=uuid, updates=update)
    client.send(
        "FileTransferStartUpload",
        source_component_uuid=uuid, transfer_uuid="t", filename="f", mime_type="m", part_count=1, size_bytes=3,
    )  # fmt: skip
    client.send("FileTransferPart", source_component_uuid=uuid, transfer_uuid="t", part_index=0, content=b"abc")
    client.send("ShareUrlRequest")


def test_no_message_takes_a_control_from_the_program_or_opens_a_tunnel(served, monkeypatch, capfd):
    opened = []
    monkeypatch.setattr(viser._viser, "ViserTunnel", lambda *_: opened.append(1))
    heard = served.server.gui.add_checkbox("heard", False)
    shown, field = served.server.gui.add_text("Iteration", "0", disabled=True), served.server.gui.add_number("n", 1.0)
    with Client(served.url) as client:
        client.look()
        for handle in (shown, field):
            _attack(client, handle._impl.uuid)
        client._socket.send("text")
        client._socket.send(b"\xff")
        client.look((0.0, 0.0))
        client.send("GuiUpdateMessage", uuid=heard._impl.uuid, updates={"value": True})
        wait_for(lambda: heard.value)
    shown.value, field.value = "17", 2.0
    assert (shown.value, field.value) == ("17", 2.0) and not opened
    said = capfd.readouterr()
    assert "Traceback" not in said.err and "warn" not in said.err.lower()


def test_a_long_message_ends_its_connection(served):
    protocol = f"viser-v{viser.__version__}"
    with connect(served.url.replace("http", "ws"), subprotocols=[protocol], compression=None) as one:
        one.send(b"a" * (connections.LARGEST + 1))
        with pytest.raises(ConnectionClosed, match="1009"):
            while True:
                one.recv(LIMIT)


def test_many_connections_leave_the_process_its_files(served, monkeypatch):
    """Each takes a file descriptor, also one that asks for nothing; a training without one cannot save."""
    monkeypatch.setattr(connections, "MOST", 4)
    port = served.server.get_port()
    taken = [socket.create_connection(("127.0.0.1", port), LIMIT) for _ in range(12)]
    wait_for(lambda: len(select.select(taken, [], [], 0)[0]) >= 8)  # nothing but an end can have come
    ended = select.select(taken, [], [], 0)[0]
    for one in taken:
        if one not in ended:
            one.sendall(f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
    answers = [one.recv(12) for one in taken if one not in ended]
    assert 1 <= answers.count(b"HTTP/1.1 200") == len(answers) <= 4  # one of an earlier test may still be there
    for one in taken:
        one.close()
    wait_for(lambda: get(port)[0] == 200)


def test_who_asks_for_nothing_does_not_keep_others_out(served, monkeypatch):
    """The oldest goes that has said nothing, then the oldest that waits for an answer; an open page stays."""
    monkeypatch.setattr(connections, "MOST", 4)
    port = served.server.get_port()
    with Client(served.url) as page:
        page.look()
        silent = [socket.create_connection(("127.0.0.1", port), LIMIT) for _ in range(10)]
        for _ in range(5):
            assert get(port)[0] == 200
        wait_for(lambda: len(select.select(silent, [], [], 0)[0]) >= 7)
        page.look((0.0, 0.0, -5.0))
        wait_for(lambda: [c for c in served.server.get_clients().values() if c.camera.position[2] == -5.0])
        for one in silent:
            one.close()


@pytest.mark.parametrize("pings", [True, False], ids=["pings", "is silent"])
def test_a_browser_that_does_not_read_is_let_go(served, monkeypatch, capfd, caplog, pings):
    """Answers to its pings pile up without a limit of websockets, and the ping that would miss it waits behind them."""
    monkeypatch.setattr(connections, "PATIENCE", LIMIT if pings else 0.5)
    monkeypatch.setattr(connections, "UNREAD", (1 << 18) if pings else (1 << 30))
    port = served.server.get_port()
    with socket.socket() as one:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        one.settimeout(LIMIT)
        one.connect(("127.0.0.1", port))
        one.sendall(_opening(port))
        shown = served.server.gui.add_text("much", secrets.token_hex(0 if pings else 4 << 20))
        frames = 2000 * (b"\x89\xfd" + bytes(4 + 125)) if pings else b"\x8a\x80" + bytes(4)  # pings, or a pong
        with pytest.raises(ConnectionError):
            for _ in range(10_000):
                one.sendall(frames)
                time.sleep(0 if pings else 0.01)
        shown.remove()
    assert get(port)[0] == 200
    assert capfd.readouterr().err == "" and not caplog.records


def test_nonsense_is_refused_without_a_word(served, capfd):
    port = served.server.get_port()
    for raw in (b"\r\n\r\n", b"\x16\x03\x01" * 50 + b"\n", b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", b""):
        with socket.create_connection(("127.0.0.1", port), LIMIT) as one:
            one.sendall(raw)
            one.shutdown(socket.SHUT_WR)
            one.recv(1000)
    assert get(port)[0] == 200
    assert capfd.readouterr().err == ""


def _opening(port: int) -> bytes:
    """A request for a websocket."""
    asks = [
        "GET / HTTP/1.1", f"Host: 127.0.0.1:{port}", "Upgrade: websocket", "Connection: Upgrade",
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Version: 13",
        f"Sec-WebSocket-Protocol: viser-v{viser.__version__}", "", "",
    ]  # fmt: skip
    return "\r\n".join(asks).encode()


def test_a_browser_that_answers_nothing_does_not_hold_the_end(monkeypatch):
    monkeypatch.setitem(serve.__init__.__kwdefaults__, "close_timeout", 3600)  # which is not to be waited for
    own = servers.serve(Address("127.0.0.1", 0), "test")
    port = own.server.get_port()
    with socket.create_connection(("127.0.0.1", port), LIMIT) as one:
        one.sendall(_opening(port))
        assert b"101" in one.recv(100)
        servers.stop(own.server)  # which itself waits for a thread that is held for seconds only
        wait_for(lambda: not own.server._websock_server._server_thread.is_alive())
