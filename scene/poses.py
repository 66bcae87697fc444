"""Corrections of camera poses: rigid motions of six numbers, through which gradients reach a pose."""

import copy
from typing import Literal, TypeVar

import torch
from torch import Tensor

AnyCamera = TypeVar("AnyCamera")
Frame = Literal["camera", "world"]


def motion(twist: Tensor) -> Tensor:
    """The rigid motion (4, 4) float64 of a twist (6,): its exponential in SE(3), the identity for zeros.

    twist: a rotation vector, in radians, then a translation, which a rotation bends (Murray, Li and Sastry 1994,
    A Mathematical Introduction to Robotic Manipulation, eq. 2.36). -twist is the inverse.
    """
    a, b, c, x, y, z = twist.double().unbind(-1)
    zero = torch.zeros_like(a)
    rows = [[zero, -c, b, x], [c, zero, -a, y], [-b, a, zero, z], [zero] * 4]
    return torch.linalg.matrix_exp(torch.stack([torch.stack(row, -1) for row in rows], -2))


def moved(camera: AnyCamera, twist: Tensor, frame: Frame = "camera") -> AnyCamera:
    """Copy a Camera or MiniCam; matrices and centre of the copy follow a twist (6,) and pass gradients to it.

    A twist of zeros gives the same matrices. R and T do not change.

    frame: the frame of the twist. "camera": the view's points move by motion(twist) in the camera's frame; "world": all
    points move in the world's frame.
    """
    old = camera.world_view_transform
    view, full, center = (values.double() for values in (old, camera.full_proj_transform, camera.camera_center))
    there, back = (motion(by * twist).to(old.device) for by in (1, -1))
    if frame == "camera":
        from_view = _invert_affine(view.T)
        there, back = (from_view @ of_view @ view.T for of_view in (there, back))
    twin = copy.copy(camera)
    twin.world_view_transform = (there.T @ view).to(old.dtype)
    twin.full_proj_transform = (there.T @ full).to(old.dtype)
    twin.camera_center = (back[:3, :3] @ center + back[:3, 3]).to(old.dtype)
    return twin


def _invert_affine(view: Tensor) -> Tensor:
    """Invert an affine map (4, 4) by cross products: a GPU would load a library of solvers for torch's inverse."""
    rows = view[:3, :3]
    dual = torch.linalg.cross(rows.roll(-1, 0), rows.roll(-2, 0))
    inverse = torch.eye(4, dtype=view.dtype, device=view.device)
    inverse[:3, :3] = dual.T / (rows[0] @ dual[0])
    inverse[:3, 3] = -(inverse[:3, :3] @ view[:3, 3])
    return inverse
