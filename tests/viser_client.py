"""A client of a viser server without a browser, written from what viser's server sends and takes."""

import http.client
import io
import socket
from http.client import HTTPMessage
from typing import Any

import msgspec.msgpack
import numpy as np
import viser
import zstandard
from PIL import Image
from websockets.sync.client import connect

_HEAD = 16  # bytes: two lengths before the compressed messages
_PATIENCE = 60.0  # seconds, as a busy machine may keep the server from its work


class Client:
    """Connects to http://HOST:PORT/ as the page's client does."""

    def __init__(self, url: str, origin: str | None = None) -> None:
        protocol = f"viser-v{viser.__version__}"
        self._socket = connect(
            url.replace("http:", "ws:"),
            subprotocols=[protocol], origin=origin, max_size=None, compression=None,
            open_timeout=_PATIENCE, close_timeout=0.2,
        )  # fmt: skip

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def send(self, kind: str, **fields: Any) -> None:
        """Send a message."""
        self._socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def look(self, position=(0.0, 0.0, -4.0), wxyz=(1.0, 0.0, 0.0, 0.0), fov=0.8, size=(96, 64)) -> None:
        """Send the camera's pose; the first one makes the client known."""
        self.send(
            "ViewerCameraMessage",
            wxyz=list(map(float, wxyz)), position=list(map(float, position)), fov=fov, near=0.01, far=100.0,
            image_width=size[0], image_height=size[1], look_at=[0.0, 0.0, 0.0], up_direction=[0.0, -1.0, 0.0],
        )  # fmt: skip

    def messages(self, timeout: float = _PATIENCE) -> list[dict[str, Any]]:
        """The messages of the next packet. TimeoutError without one."""
        packet = self._socket.recv(timeout)
        length = int.from_bytes(packet[8:_HEAD], "little")
        unpacked = zstandard.ZstdDecompressor().decompress(packet[_HEAD : _HEAD + length])
        return msgspec.msgpack.decode(unpacked)["messages"]

    def until(self, kind: str, timeout: float = _PATIENCE) -> dict[str, Any]:
        """The next message of a kind."""
        while True:
            for message in self.messages(timeout):
                if message["type"] == kind:
                    return message

    def picture(self, timeout: float = _PATIENCE) -> np.ndarray:
        """The next picture (H, W, 3) uint8."""
        message = {"rgb_data": None}  # as a server sends it that has been reset
        while message["rgb_data"] is None:
            message = self.until("BackgroundImageMessage", timeout)
        with Image.open(io.BytesIO(message["rgb_data"])) as image:
            return np.asarray(image.convert("RGB"))


def get(port: int, path: str = "/", **headers: str) -> tuple[int, HTTPMessage, bytes]:
    """Status, headers and body of a request whose path and headers are sent as they are."""
    given = {"Host": f"127.0.0.1:{port}"} | {name.replace("_", "-"): value for name, value in headers.items()}
    lines = [f"GET {path} HTTP/1.1", *(f"{name}: {value}" for name, value in given.items())]
    with socket.create_connection(("127.0.0.1", port), _PATIENCE) as asked:
        asked.sendall("\r\n".join([*lines, "", ""]).encode("latin-1"))
        answered = http.client.HTTPResponse(asked)
        answered.begin()
        return answered.status, answered.headers, answered.read()
