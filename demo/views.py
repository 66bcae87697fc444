"""Positions of the demo's cameras: rings around the scene at three heights."""

from __future__ import annotations

import numpy as np

from demo.tracer import View

TARGET = np.asarray([0.1, -0.4, 0.1])  # point that the cameras face, world units
RINGS = ((12.0, 3.9, 0.40), (28.0, 3.6, 0.35), (50.0, 3.3, 0.25))  # elevation in degrees, distance, share of the views


def look_at(center: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the world-to-camera rotation (3, 3) of an upright camera at `center` facing `target`, (3,); up is -y."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross((0.0, 1.0, 0.0), forward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def ring_views(count: int, width: int, height: int, rng: np.random.Generator) -> list[View]:
    """Make `count` cameras around the scene with small random jitter of position and aim; focal length 0.9 widths."""
    shares = np.round(np.cumsum([share for *_, share in RINGS]) * count).astype(int)
    views: list[View] = []
    for ring, (elevation, distance, _) in enumerate(RINGS):
        members = shares[ring] - (shares[ring - 1] if ring else 0)
        for k in range(members):
            azimuth = 2 * np.pi * (k + ring / len(RINGS) + rng.uniform(-0.15, 0.15)) / members
            tilt = np.radians(elevation + rng.uniform(-2, 2))
            outward = np.asarray([np.cos(tilt) * np.sin(azimuth), -np.sin(tilt), np.cos(tilt) * np.cos(azimuth)])
            center = TARGET + distance * rng.uniform(0.95, 1.05) * outward
            aim = TARGET + rng.uniform(-0.15, 0.15, 3)
            views.append(View(look_at(center, aim), center, 0.9 * width, width, height))
    return views
