"""Views between neighbouring cameras: where a visitor of the scene may stand without having been photographed there."""

import math
from collections.abc import Sequence

import numpy as np
import torch

from gaussian_renderer.free_view import rotation_matrix
from scene.cameras import ZFAR, ZNEAR, Camera, MiniCam
from utils.graphics_utils import focal2fov, projection, world_to_camera

NEAREST = 3  # neighbours of each camera; in a sequence and in a ring its two sides are among them
FRACTIONS = (0.2, 0.4, 0.6, 0.8)  # of the way from a camera to its neighbour
WIDER = 1.5  # size of a view between, in sizes of its cameras: a visitor may look elsewhere than they did


def neighbours(cameras: Sequence[Camera], nearest: int = NEAREST) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of cameras to walk between, by their index; ascending.

    A pair's distance is that of the centres plus the angle between the orientations, each in units of its median over
    all pairs. Each camera is paired with its `nearest` ones. The minimum spanning tree comes on top, so that groups of
    cameras far from each other are joined, too. Memory: some 50 bytes for each two cameras.
    """
    count = len(cameras)
    if count < 2:
        return []
    distances = _distances(cameras)
    pairs = {(min(i, j), max(i, j)) for i, j in _tree(distances)}
    np.fill_diagonal(distances, np.inf)
    for i, order in enumerate(np.argsort(distances, axis=1, kind="stable")[:, : min(nearest, count - 1)].tolist()):
        pairs |= {(min(i, j), max(i, j)) for j in order}
    return sorted(pairs)


def _distances(cameras: Sequence[Camera]) -> np.ndarray:
    """(N, N) distances of `neighbours`."""
    centers = np.array([_center(camera) for camera in cameras])
    turns = np.array([camera.R for camera in cameras]).reshape(-1, 9)
    far = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    turned = np.arccos(np.clip((turns @ turns.T - 1) / 2, -1, 1))  # the trace of Ra^T Rb is 1 + 2 cos(angle)
    total = np.zeros_like(far)
    above = np.triu_indices(len(cameras), 1)
    for part in (far, turned):
        if (unit := np.median(part[above])) > 0:
            total += part / unit
    return total


def _tree(distances: np.ndarray) -> list[tuple[int, int]]:
    """Edges of the minimum spanning tree (Prim's algorithm)."""
    outside = np.ones(len(distances), dtype=bool)
    outside[0] = False
    nearest, parent = distances[0].copy(), np.zeros(len(distances), dtype=int)
    edges = []
    while outside.any():
        new = int(np.where(outside, nearest, np.inf).argmin())
        edges.append((int(parent[new]), new))
        outside[new] = False
        closer = distances[new] < nearest
        nearest, parent = np.where(closer, distances[new], nearest), np.where(closer, new, parent)
    return edges


def views_between(first: Camera, second: Camera) -> list[MiniCam]:
    """A view at each of FRACTIONS of the way between two cameras, WIDER than they are.

    Positions, focal lengths and principal points are interpolated linearly, orientations along the shortest rotation
    (slerp). Where the sizes differ, the larger width and height count.
    """
    return [_between(first, second, fraction) for fraction in FRACTIONS]


def _between(first: Camera, second: Camera, fraction: float) -> MiniCam:
    def mixed(one: float, other: float) -> float:
        return (1 - fraction) * one + fraction * other

    turn = _slerp(first.R, second.R, fraction)
    center = mixed(_center(first), _center(second))
    width, height = (
        math.ceil(WIDER * max(getattr(first, side), getattr(second, side))) for side in ("image_width", "image_height")
    )
    fovx, fovy = focal2fov(mixed(first.fx, second.fx), width), focal2fov(mixed(first.fy, second.fy), height)
    # Offsets of the principal point from the image's centre stay what they are in pixels.
    shift_x = mixed(first.cx - first.image_width / 2, second.cx - second.image_width / 2)
    shift_y = mixed(first.cy - first.image_height / 2, second.cy - second.image_height / 2)
    view = torch.from_numpy(world_to_camera(turn, -turn.T @ center))
    project = projection(ZNEAR, ZFAR, fovx, fovy, 2 * shift_x / width, 2 * shift_y / height)
    matrices = [m.T.to(first.device, torch.float32).contiguous() for m in (view, project @ view)]
    return MiniCam(width, height, fovy, fovx, ZNEAR, ZFAR, *matrices)


def _center(camera: Camera) -> np.ndarray:
    return -camera.R @ camera.T


def _slerp(first: np.ndarray, second: np.ndarray, fraction: float) -> np.ndarray:
    """Rotation at a fraction of the way, by quaternions (Shoemake 1985), along the shorter arc."""
    one, other = _quaternion(first), _quaternion(second)
    if one @ other < 0:
        other = -other
    angle = math.acos(min(1.0, float(one @ other)))
    if angle < 1e-6:
        mixed = (1 - fraction) * one + fraction * other
    else:
        mixed = math.sin((1 - fraction) * angle) * one + math.sin(fraction * angle) * other
    return rotation_matrix(mixed / np.linalg.norm(mixed))


def _quaternion(turn: np.ndarray) -> np.ndarray:
    """Unit quaternion wxyz of a rotation matrix: the eigenvector of Bar-Itzhack 2000, stable for every angle."""
    m = turn
    k = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    return np.linalg.eigh(k)[1][:, -1]
