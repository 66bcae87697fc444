"""Parse requests of the remote viewer: text in, checked values out. No sockets here."""

import json
import math
import sys
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from scene.cameras import MiniCam
from utils.graphics_utils import rigid_pose
from utils.system_utils import UserError

MOST_SIDE = 8192  # pixels
MOST_PIXELS = 4096 * 4096  # of a frame
MOST_SCALING = 10.0


class BadMessage(ValueError):
    """A request that cannot be answered. Its text names the field and never quotes the sender."""


@dataclass(frozen=True)
class Request:
    """One frame that a viewer asks for, and whether training may go on after it."""

    width: int  # pixels
    height: int
    fov_x: float  # radians
    fov_y: float
    z_near: float  # world units
    z_far: float
    view: Tensor  # (4,4) float32, transposed as in MiniCam, camera axes x right, y down, z forward
    view_projection: Tensor  # (4,4) float32, likewise
    scaling_modifier: float
    shs_python: bool  # colours from torch, for this frame
    rot_scale_python: bool  # covariances from torch, for this frame
    train: bool
    keep_alive: bool  # stay after the last iteration

    def camera(self, device: torch.device) -> MiniCam:
        """Make the view that the request asks for."""
        matrices = self.view.to(device), self.view_projection.to(device)
        return MiniCam(self.width, self.height, self.fov_y, self.fov_x, self.z_near, self.z_far, *matrices)


def decode(text: bytes) -> dict[str, Any]:
    """Parse the JSON object of a message. BadMessage if it is none."""
    try:
        message = json.loads(text.decode("utf-8"))
    except (ValueError, RecursionError) as error:  # wrong UTF-8, wrong JSON or a number of too many digits
        raise BadMessage("its message is not JSON") from error
    if not isinstance(message, dict):
        raise BadMessage("its message is not a JSON object")
    return message


def parse(message: dict[str, Any]) -> Request | None:
    """Make the request of a message; None if a resolution is 0, when no other field is read.

    BadMessage for a field that is missing, of another type, not finite or out of range, and for a view matrix that is
    singular, mirrored or sheared. A scale in the matrix is divided out.
    """
    width, height = (_read_size(message, f"resolution_{axis}") for axis in "xy")
    if width == 0 or height == 0:
        return None
    if not (1 <= width <= MOST_SIDE and 1 <= height <= MOST_SIDE and width * height <= MOST_PIXELS):
        raise BadMessage(f"its resolution is not within 1 to {MOST_SIDE} a side and {MOST_PIXELS:,} pixels")
    fov_x, fov_y = (_read_number(message, f"fov_{axis}") for axis in "xy")
    if not (0 < fov_x < math.pi and 0 < fov_y < math.pi):
        raise BadMessage("its fov_x or fov_y is not between 0 and pi")
    z_near, z_far = (_read_number(message, f"z_{end}") for end in ("near", "far"))
    scaling = _read_number(message, "scaling_modifier")
    if not 0 <= scaling <= MOST_SCALING:
        raise BadMessage(f"its scaling_modifier is not within 0 to {MOST_SCALING:g}")
    flags = {name: _read_flag(message, name) for name in ("shs_python", "rot_scale_python", "train", "keep_alive")}
    view, view_projection = (_read_matrix(message, name) for name in ("view_matrix", "view_projection_matrix"))
    view[:, 1:3] *= -1  # the viewer's y and z axes point the other way
    view_projection[:, 1] *= -1
    _divide_scale_out(view)
    inverse, failed = torch.linalg.inv_ex(view)
    if failed or not inverse.isfinite().all():
        raise BadMessage("its view_matrix is singular")
    return Request(width, height, fov_x, fov_y, z_near, z_far, view, view_projection, scaling, **flags)


def _divide_scale_out(view: Tensor) -> None:
    """Divide the scale out of a transposed view matrix (4, 4), in place. BadMessage where it is no similarity."""
    try:
        turn, shift = rigid_pose(view[:3, :3].numpy(), view[3, :3].numpy(), "the viewer")
    except UserError as error:
        raise BadMessage("its view_matrix is singular, sheared or mirrored") from error
    view[:3, :3], view[3, :3] = torch.from_numpy(turn), torch.from_numpy(shift)


def _read_field(message: dict[str, Any], name: str) -> Any:
    if name not in message:
        raise BadMessage(f"its message has no {name}")
    return message[name]


def _read_size(message: dict[str, Any], name: str) -> int:
    value = _read_field(message, name)
    if type(value) is not int:
        raise BadMessage(f"its {name} is not a whole number")
    return value


def _read_flag(message: dict[str, Any], name: str) -> bool:
    value = _read_field(message, name)
    if type(value) not in (int, bool) or value not in (0, 1):
        raise BadMessage(f"its {name} is neither 0 nor 1")
    return bool(value)


def _read_number(message: dict[str, Any], name: str) -> float:
    return _check_finite(_read_field(message, name), name)


def _check_finite(value: Any, name: str) -> float:
    """Return a number of a message as a float. BadMessage, with its name, if it is no finite number."""
    if type(value) not in (int, float):
        raise BadMessage(f"its {name} is not a number")
    if not abs(value) <= sys.float_info.max:  # also a whole number that no float can hold
        raise BadMessage(f"its {name} is not finite")
    return float(value)


def _read_matrix(message: dict[str, Any], name: str) -> Tensor:
    """Read sixteen numbers, row by row, as (4,4) float32 on the CPU."""
    values = _read_field(message, name)
    if type(values) is not list or len(values) != 16:
        raise BadMessage(f"its {name} is not a list of 16 numbers")
    matrix = torch.tensor([_check_finite(value, name) for value in values], dtype=torch.float64, device="cpu")
    matrix = matrix.to(torch.float32).view(4, 4)
    if not matrix.isfinite().all():
        raise BadMessage(f"its {name} is not finite")
    return matrix
