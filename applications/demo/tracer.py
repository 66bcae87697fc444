"""A small ray tracer: sun with shadows, sky light, highlights, and one bounce of reflection on glossy things.

Its cameras stand on rings around the scene, at three heights.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

import numpy as np

from applications.demo.objects import Thing, dot, normalize

SUN = normalize(np.asarray([[-0.55], [-1.0], [-0.45]], np.float32))  # towards the sun; up is -y
SUN_COLOUR = np.asarray([[0.74], [0.70], [0.62]], np.float32)
SKY_COLOUR = np.asarray([[0.40], [0.44], [0.50]], np.float32)
TARGET = np.asarray([0.1, -0.4, 0.1])  # point that the cameras face, world units
RINGS = ((12.0, 3.9, 0.40), (28.0, 3.6, 0.35), (50.0, 3.3, 0.25))  # elevation in degrees, distance, share of the views
NEARER = 0.6  # distances of wide cameras, as a share of the pinholes'
FISHEYE, PANORAMA = "OPENCV_FISHEYE", "EQUIRECTANGULAR"  # COLMAP's names; an equidistant fisheye without distortion
CAMERAS = {"pinhole": "PINHOLE", "fisheye": FISHEYE, "panorama": PANORAMA}
BLOCK = 32768  # rays traced at once; their arrays fit in the cache of a core


@dataclass(frozen=True)
class View:
    """A camera of one of the models of CAMERAS, whose principal point is the centre of the image."""

    rotation: np.ndarray  # (3, 3), world to camera: x right, y down, z forward
    center: np.ndarray  # (3,), position in the world
    focal: float  # pixels
    width: int
    height: int
    _: KW_ONLY
    model: str = "PINHOLE"

    @property
    def params(self) -> list[float]:
        """COLMAP's parameters."""
        if self.model == PANORAMA:
            return [self.width, self.height]
        return [self.focal, self.focal, self.width / 2, self.height / 2, *[0.0] * (4 if self.model == FISHEYE else 0)]

    def rays(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return unit directions (3, R) in the world through image positions (R,) in pixels; centres are at .5."""
        across, down = (x - self.width / 2) / self.focal, (y - self.height / 2) / self.focal
        local = [across, down, np.ones_like(x)]
        if self.model == FISHEYE:
            angle = np.hypot(across, down)
            local = [across * np.sinc(angle / np.pi), down * np.sinc(angle / np.pi), np.cos(angle)]
        elif self.model == PANORAMA:
            local = [np.sin(across) * np.cos(down), np.sin(down), np.cos(across) * np.cos(down)]
        return normalize((self.rotation.T @ np.stack(local)).astype(np.float32))

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return image positions x, y (R,) in pixels and depths (R,) of world points (3, R).

        The depth is z, but the distance for cameras that show what is beside them.
        """
        local = self.rotation @ (points - self.center.reshape(3, 1))
        depth = local[2] if self.model == "PINHOLE" else np.linalg.norm(local, axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.model == PANORAMA:
                across, down = np.arctan2(local[0], local[2]), np.arctan2(local[1], np.hypot(local[0], local[2]))
                return self.focal * across + self.width / 2, self.focal * down + self.height / 2, depth
            over = local[2]
            if self.model == FISHEYE:
                away = np.hypot(local[0], local[1])
                over = away / np.arctan2(away, local[2])
            x = self.focal * local[0] / over + self.width / 2
            y = self.focal * local[1] / over + self.height / 2
        return x, y, depth


def look_at(center: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the world-to-camera rotation (3, 3) of an upright camera at `center` facing `target`, (3,); up is -y."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross((0.0, 1.0, 0.0), forward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def ring_views(count: int, width: int, height: int, rng: np.random.Generator, model: str = "PINHOLE") -> list[View]:
    """Make `count` cameras around the scene with small random jitter of position and aim.

    A pinhole has a focal length of 0.9 widths. A fisheye is 200 degrees wide. A panorama's camera stands upright.
    """
    focal = width * {FISHEYE: 1 / np.radians(200), PANORAMA: 1 / (2 * np.pi)}.get(model, 0.9)
    near = 1.0 if model == "PINHOLE" else NEARER
    shares = np.round(np.cumsum([share for *_, share in RINGS]) * count).astype(int)
    views: list[View] = []
    for ring, (elevation, distance, _) in enumerate(RINGS):
        members = shares[ring] - (shares[ring - 1] if ring else 0)
        for k in range(members):
            azimuth = 2 * np.pi * (k + ring / len(RINGS) + rng.uniform(-0.15, 0.15)) / members
            tilt = np.radians(elevation + rng.uniform(-2, 2))
            outward = np.asarray([np.cos(tilt) * np.sin(azimuth), -np.sin(tilt), np.cos(tilt) * np.cos(azimuth)])
            center = TARGET + near * distance * rng.uniform(0.95, 1.05) * outward
            aim = TARGET + rng.uniform(-0.15, 0.15, 3)
            if model == PANORAMA:
                aim[1] = center[1]
            views.append(View(look_at(center, aim), center, focal, width, height, model=model))
    return views


def trace(things: list[Thing], origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance (R,) to the nearest thing along each ray, and the thing's index (R,)."""
    nearest = things[0].shape.intersect(origin, direction)
    index = np.zeros(nearest.shape, np.int8)
    for k, thing in enumerate(things[1:], 1):
        t = thing.shape.intersect(origin, direction)
        closer = t < nearest
        np.copyto(nearest, t, where=closer)
        index[closer] = k
    return nearest, index


def in_shadow(things: list[Thing], points: np.ndarray) -> np.ndarray:
    """Return whether something is between points (3, R) and the sun, (R,) bool."""
    direction = np.broadcast_to(SUN, points.shape)
    blocked = np.zeros(points.shape[1], bool)
    for thing in things:
        if not thing.emissive:
            blocked |= np.isfinite(thing.shape.intersect(points, direction))
    return blocked


def shade(things: list[Thing], origin: np.ndarray, direction: np.ndarray, bounces: int = 1) -> np.ndarray:
    """Return the colours (3, R) seen along rays from origins (3, R) or (3, 1) in unit directions (3, R)."""
    distance, index = trace(things, origin, direction)
    points = origin + distance * direction
    colour = np.empty_like(points)
    for k, thing in enumerate(things):
        hit = np.flatnonzero(index == k)
        if hit.size == 0:
            continue
        p, d = points[:, hit], direction[:, hit]
        if thing.emissive:
            colour[:, hit] = thing.texture(p)
            continue
        n = thing.shape.normal(p)
        lifted = p + np.float32(2e-3) * n
        sun = np.where(in_shadow(things, lifted), np.float32(0), np.maximum(dot(n, SUN), 0))
        sky = np.float32(0.6) - np.float32(0.4) * n[1]
        c = thing.texture(p) * (SUN_COLOUR * sun + SKY_COLOUR * sky)
        if thing.highlight:
            half = normalize(SUN - d)
            c += np.float32(thing.highlight) * np.maximum(dot(n, half), 0) ** np.float32(thing.exponent) * (sun > 0)
        if thing.mirror and bounces:
            facing = -dot(n, d)
            fresnel = thing.mirror + (1 - thing.mirror) * np.clip(1 - facing, 0, 1) ** 5  # Schlick 1994
            seen = shade(things, lifted, d + 2 * facing * n, bounces - 1)
            c += np.float32(0.8) * fresnel.astype(np.float32) * (seen - c)
        colour[:, hit] = c
    return colour


def render_view(things: list[Thing], view: View, samples: int = 3) -> np.ndarray:
    """Render the image (H, W, 3) uint8 of a view, the mean of samples x samples rays per pixel."""
    origin = view.center.astype(np.float32).reshape(3, 1)
    steps = (np.arange(samples) + 0.5) / samples
    columns = (np.arange(view.width)[:, None] + steps).reshape(-1)
    rows_at_once = max(1, BLOCK // (columns.size * samples))
    image = np.empty((view.height, view.width, 3), np.uint8)
    for top in range(0, view.height, rows_at_once):
        rows = np.arange(top, min(top + rows_at_once, view.height))
        y, x = np.meshgrid((rows[:, None] + steps).reshape(-1), columns, indexing="ij")
        colour = np.clip(shade(things, origin, view.rays(x.reshape(-1), y.reshape(-1))), 0, 1)
        block = colour.reshape(3, rows.size, samples, view.width, samples).mean(axis=(2, 4))
        image[rows] = np.floor(block * 255 + 0.5).astype(np.uint8).transpose(1, 2, 0)
    return image
