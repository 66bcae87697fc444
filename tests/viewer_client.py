"""A remote viewer for the tests, written from the protocol's description alone."""

import json
import socket
import struct

import numpy as np
import torch
from waiting import LIMIT

from scene.cameras import MiniCam

FIELDS = (
    *("resolution_x", "resolution_y", "train", "fov_y", "fov_x", "z_near", "z_far", "shs_python", "rot_scale_python"),
    *("keep_alive", "scaling_modifier", "view_matrix", "view_projection_matrix"),
)


def request(camera: MiniCam, **changes: object) -> dict[str, object]:
    """The message for a view; by default it pauses training."""
    view = camera.world_view_transform.cpu().double().numpy().copy()
    full = camera.full_proj_transform.cpu().double().numpy().copy()
    for matrix, column in ((view, 1), (view, 2), (full, 1)):
        matrix[:, column] = -matrix[:, column]
    size = camera.image_width, camera.image_height
    lens = camera.FoVy, camera.FoVx, camera.znear, camera.zfar
    values = (*size, 0, *lens, 0, 0, 0, 1.0, view.flatten().tolist(), full.flatten().tolist())
    return dict(zip(FIELDS, values, strict=True)) | changes


def packed(message: object) -> bytes:
    """The bytes of a message on the wire."""
    text = message if isinstance(message, bytes) else json.dumps(message).encode()
    return struct.pack("<I", len(text)) + text


class Viewer:
    """A connection to a training. buffer: bytes that the system may keep for it."""

    def __init__(self, port: int, buffer: int | None = None) -> None:
        self.socket = socket.socket()
        if buffer:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
        self.socket.settimeout(LIMIT)
        self.socket.connect(("127.0.0.1", port))

    def say(self, message: object) -> None:
        """Send a message, or bytes after their length."""
        self.socket.sendall(packed(message))

    def take(self, count: int) -> bytes:
        """Receive so many bytes; fewer if the connection ends before."""
        received = b""
        while len(received) < count and (part := self.socket.recv(count - len(received))):
            received += part
        return received

    def path(self) -> str:
        """Receive the end of an answer."""
        return self.take(struct.unpack("<I", self.take(4))[0]).decode("ascii")

    def ask(self, message: dict[str, object]) -> tuple[np.ndarray, str]:
        """Send a request; its frame (H, W, 3) uint8 and the path."""
        self.say(message)
        shape = message["resolution_y"], message["resolution_x"], 3
        frame = np.frombuffer(self.take(int(np.prod(shape))), np.uint8).reshape(shape)
        return frame, self.path()

    def is_let_go(self) -> bool:
        """Wait for the end of the connection; whether nothing came before it."""
        try:
            return self.socket.recv(1) == b""
        except ConnectionResetError:  # it had sent what nobody has read
            return True

    def leave(self) -> None:
        """Close the connection."""
        self.socket.close()


def as_bytes(image: torch.Tensor) -> np.ndarray:
    """A rendered image (3, H, W) as the protocol sends it: truncated, (H, W, 3)."""
    scaled = 255 * image.detach().clamp(0, 1).permute(1, 2, 0)
    return scaled.cpu().numpy().astype(np.uint8)
