"""Splats of a room with a step in its floor, and photos' cameras in it, for tests of walking. Metres, y down."""

import math

import numpy as np

from gaussian_renderer.free_view import free_view
from scene.cameras import MiniCam
from scene.splats.splats import Splats
from utils.sh_utils import C0

HALF = 3.0  # from the middle to each wall
HIGH = 2.6  # of the ceiling
STEP = 0.25, 1.0  # height of the floor's higher part, and the z from which it begins
_APART = 0.12  # from one Gaussian to the next


def room() -> Splats:
    """Opaque walls, floors and ceiling."""
    line = np.arange(-HALF, HALF + 1e-6, _APART)
    up = np.arange(0, HIGH + 1e-6, _APART)
    sides = []
    for across, along, make in (
        (line, line, lambda a, b: (a, -STEP[0] * (b > STEP[1]), b)),
        (line, line, lambda a, b: (a, 0 * a - HIGH, b)),
        *((line, up, lambda a, b, s=s: (a, -b, 0 * a + s * HALF)) for s in (-1, 1)),
        *((line, up, lambda a, b, s=s: (0 * a + s * HALF, -b, a)) for s in (-1, 1)),
        (line, np.arange(0, STEP[0], _APART / 2), lambda a, b: (a, -b, 0 * a + STEP[1])),
    ):
        a, b = (values.ravel() for values in np.meshgrid(across, along))
        sides.append(np.stack(make(a, b), axis=1))
    means = np.concatenate(sides)
    count = len(means)
    colours = np.random.default_rng(0).uniform(0.2, 0.9, (count, 1, 3))
    values = (
        means,
        np.full((count, 3), math.log(0.05)),
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.full(count, 6.0),
        (colours - 0.5) / C0,
    )
    return Splats(*(value.astype(np.float32) for value in values))


def cameras(count: int = 12, unit: float = 1.0, height: float = 1.5) -> list[MiniCam]:
    """Cameras in the middle of the room that look around, metres above its floor. unit: of a metre."""
    found = []
    for number in range(count):
        half, down = math.pi * number / count, math.radians((number % 3 - 1) * 25) / 2
        turn = [math.cos(half) * math.cos(down), math.cos(half) * math.sin(down), math.sin(half) * math.cos(down)]
        wxyz = [*turn, -math.sin(half) * math.sin(down)]
        camera = free_view(160, 120, math.radians(70), [0.0, -height * unit, 0.0], wxyz, "cpu")
        camera.image_name = f"photo_{number}.jpg"
        found.append(camera)
    return found
