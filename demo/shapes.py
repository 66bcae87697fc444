"""Analytic shapes: their intersections with rays, and their normals.

Rays and points are arrays of shape (3, R), float32, world units. The world has x right, y down, z forward, like a
COLMAP camera, so that "up" is -y. A ray without a hit has distance infinity.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

NEAR = np.float32(1e-3)  # rays that start on a surface must not hit it again


class Shape(Protocol):
    """The interface of a shape for the tracer."""

    def intersect(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return distances (R,) to the first hit beyond NEAR; origin (3, R) or (3, 1), unit direction (3, R)."""

    def normal(self, points: np.ndarray) -> np.ndarray:
        """Return unit normals (3, R) at surface points (3, R), pointing out of the solid."""


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return scalar products (R,) of vectors (3, R)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def normalize(v: np.ndarray) -> np.ndarray:
    """Scale vectors (3, R) to length one."""
    return v / np.sqrt(dot(v, v))


def _column(values: tuple[float, float, float]) -> np.ndarray:
    return np.asarray(values, np.float32).reshape(3, 1)


@dataclass(frozen=True)
class Ground:
    """A disc around the origin in the plane y = 0, seen from above."""

    radius: float

    def intersect(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -origin[1] / direction[1]
            x = origin[0] + t * direction[0]
            z = origin[2] + t * direction[2]
            hit = (t > NEAR) & (x * x + z * z < self.radius**2)
        return np.where(hit, t, np.float32(np.inf))

    def normal(self, points: np.ndarray) -> np.ndarray:
        return np.broadcast_to(_column((0, -1, 0)), points.shape)


@dataclass(frozen=True)
class Sphere:
    """A sphere; `inside` turns its normals inwards, for the backdrop."""

    center: tuple[float, float, float]
    radius: float
    inside: bool = False

    def intersect(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        oc = origin - _column(self.center)
        b = dot(oc, direction)
        discriminant = b * b - (dot(oc, oc) - np.float32(self.radius**2))
        with np.errstate(invalid="ignore"):
            root = np.sqrt(discriminant)
            near, far = -b - root, -b + root
            t = np.where(near > NEAR, near, far)
            return np.where(t > NEAR, t, np.float32(np.inf))

    def normal(self, points: np.ndarray) -> np.ndarray:
        n = (points - _column(self.center)) / np.float32(self.radius)
        return -n if self.inside else n


@dataclass(frozen=True)
class Torus:
    """A torus around an axis, found by sphere tracing of its exact distance function within its bounding sphere."""

    center: tuple[float, float, float]
    axis: tuple[float, float, float]
    radius: float
    tube: float

    def _local(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return offset from the centre (3, R), height over the torus' plane (R,) and distance from its axis (R,)."""
        offset = points - _column(self.center)
        height = dot(offset, normalize(_column(self.axis)))
        return offset, height, np.sqrt(np.maximum(dot(offset, offset) - height * height, np.float32(1e-12)))

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return signed distances (R,) of points (3, R) from the surface."""
        _, height, ring = self._local(points)
        return np.hypot(ring - np.float32(self.radius), height) - np.float32(self.tube)

    def intersect(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        bound = self.radius + self.tube
        oc = origin - _column(self.center)
        b = dot(oc, direction)
        discriminant = b * b - (dot(oc, oc) - np.float32(bound**2))
        result = np.full(b.shape, np.inf, np.float32)
        active = np.flatnonzero((discriminant > 0) & (np.sqrt(np.maximum(discriminant, 0)) > b))
        origin = np.broadcast_to(origin, direction.shape)
        root = np.sqrt(discriminant[active])
        t, end = np.maximum(-b[active] - root, np.float32(5) * NEAR), -b[active] + root
        # Steps never overshoot. A ray that grazes the tube before it hits needs more than a hundred of them.
        for _ in range(256):
            d = self.distance(origin[:, active] + t * direction[:, active])
            hit = d < 2e-4
            result[active[hit]] = t[hit]
            t = t + d
            keep = ~hit & (t < end)
            active, t, end = active[keep], t[keep], end[keep]
            if active.size == 0:
                break
        return result

    def normal(self, points: np.ndarray) -> np.ndarray:
        offset, height, ring = self._local(points)
        axis = normalize(_column(self.axis))
        ring_point = (offset - height * axis) * (np.float32(self.radius) / ring)
        return normalize(offset - ring_point)


@dataclass(frozen=True)
class Box:
    """An upright box, turned about the vertical axis by `turn` radians; `half` are its half sizes."""

    center: tuple[float, float, float]
    half: tuple[float, float, float]
    turn: float

    def _to_local(self, v: np.ndarray) -> np.ndarray:
        c, s = np.float32(np.cos(self.turn)), np.float32(np.sin(self.turn))
        return np.stack([c * v[0] - s * v[2], v[1], s * v[0] + c * v[2]])

    def _to_world(self, v: np.ndarray) -> np.ndarray:
        c, s = np.float32(np.cos(self.turn)), np.float32(np.sin(self.turn))
        return np.stack([c * v[0] + s * v[2], v[1], -s * v[0] + c * v[2]])

    def local(self, points: np.ndarray) -> np.ndarray:
        """Return points (3, R) in the box's own frame, in units of its half sizes: the surface is at max |.| = 1."""
        return self._to_local(points - _column(self.center)) / _column(self.half)

    def intersect(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        o = self._to_local(origin - _column(self.center))
        d = self._to_local(direction)
        half = _column(self.half)
        with np.errstate(divide="ignore", invalid="ignore"):
            middle, reach = -o / d, np.abs(half / d)
            enter = (middle - reach).max(axis=0)
            leave = (middle + reach).min(axis=0)
            t = np.where(enter > NEAR, enter, leave)
            return np.where((leave >= enter) & (t > NEAR), t, np.float32(np.inf))

    def normal(self, points: np.ndarray) -> np.ndarray:
        q = self.local(points)
        face = np.argmax(np.abs(q), axis=0)
        index = np.arange(q.shape[1])
        n = np.zeros_like(q)
        n[face, index] = np.sign(q[face, index])
        return self._to_world(n)
