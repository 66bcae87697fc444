"""Splats and cameras for tests of HTML pages: a red ball over a blue one, in a world whose up is slanted."""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from gaussian_renderer.camera_paths.poses import look_along
from gaussian_renderer.free_view import free_view
from scene.cameras import MiniCam
from scene.splats.splats import Splats
from utils.sh_utils import C0

UP = Rotation.from_rotvec([0.5, 0.3, 0.9]).apply([0.0, -1.0, 0.0])  # of unit length
SIZE = 400, 300
FOV = 45.0  # vertical, degrees
CENTRE = np.array([0.4, -0.2, 0.3])


def balls(degree: int = 1, each: int = 300) -> Splats:
    """Two balls of Gaussians, one over the other, whose colours depend a little on the direction."""
    rng = np.random.default_rng(0)
    count = 2 * each
    points = rng.normal(size=(count, 3))
    points *= 0.45 * rng.random((count, 1)) ** (1 / 3) / np.linalg.norm(points, axis=1, keepdims=True)
    upper = np.arange(count) < each
    sh = rng.normal(scale=0.15, size=(count, (degree + 1) ** 2, 3))
    colours = np.where(upper[:, None], [0.9, 0.1, 0.1], [0.1, 0.1, 0.9]) + rng.normal(scale=0.1, size=(count, 3))
    sh[:, 0] = (colours - 0.5) / C0
    rotations = Rotation.random(count, random_state=1).as_quat(scalar_first=True)
    values = (
        CENTRE + points + np.where(upper, 0.5, -0.5)[:, None] * UP,
        np.log(rng.uniform(0.06, 0.15, size=(count, 3))),
        rotations,
        rng.normal(1.0, 1.0, size=count),
        sh,
    )
    return Splats(*(value.astype(np.float32) for value in values))


def cameras(count: int = 8, rolls: tuple[float, ...] = (12.0,)) -> list[MiniCam]:
    """Cameras on a ring around the balls, that look down at them. rolls: degrees by which the first ones lean."""
    across = np.linalg.svd(UP[None])[2][1:]
    found = []
    for number in range(count):
        angle = 2 * math.pi * number / count
        offset = 3.5 * (math.cos(angle) * across[0] + math.sin(angle) * across[1]) + 1.2 * UP
        roll = rolls[number] if number < len(rolls) else 0.0
        turn = look_along(-offset, UP) @ Rotation.from_euler("z", roll, degrees=True).as_matrix()
        wxyz = Rotation.from_matrix(turn).as_quat(scalar_first=True).tolist()
        camera = free_view(*SIZE, math.radians(FOV), (CENTRE + offset).tolist(), wxyz, "cpu")
        camera.image_name = f"photo_{number}.jpg"
        found.append(camera)
    return found
