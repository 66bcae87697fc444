"""Objects of the demo scene: analytic shapes with textures and finish.

Rays and points are arrays of shape (3, R), float32, world units. The world has x right, y down, z forward, like a
COLMAP camera, so that "up" is -y. A ray without a hit has distance infinity.

A texture is a function from surface points (3, R) to diffuse colours (3, R) in [0, 1]. All textures are smooth or
soft-edged at the scale of a pixel, so that supersampling is enough against aliasing.

A shape has two methods. `intersect` returns distances (R,) to the first hit beyond NEAR; origin (3, R) or (3, 1), unit
direction (3, R). `normal` returns unit normals (3, R) at surface points (3, R), pointing out of the solid.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Texture = Callable[[np.ndarray], np.ndarray]
NEAR = np.float32(1e-3)  # rays that start on a surface must not hit it again


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return scalar products (R,) of vectors (3, R)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def normalize(v: np.ndarray) -> np.ndarray:
    """Scale vectors (3, R) to length one."""
    return v / np.sqrt(dot(v, v))


def _make_column(*values: float) -> np.ndarray:
    return np.asarray(values, np.float32).reshape(3, 1)


@dataclass(frozen=True)
class Ground:
    """A disc around the origin in the plane y = 0, seen from above."""

    radius: float

    def intersect(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return the distance (R,) along each ray to the ground."""
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -origin[1] / direction[1]
            x = origin[0] + t * direction[0]
            z = origin[2] + t * direction[2]
            hit = (t > NEAR) & (x * x + z * z < self.radius**2)
        return np.where(hit, t, np.float32(np.inf))

    def normal(self, points: np.ndarray) -> np.ndarray:
        return np.broadcast_to(_make_column(0, -1, 0), points.shape)


@dataclass(frozen=True)
class Sphere:
    """A sphere; `inside` turns its normals inwards, for the backdrop."""

    center: tuple[float, float, float]
    radius: float
    inside: bool = False

    def intersect(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return the distance (R,) along each ray to the sphere, also from inside."""
        oc = origin - _make_column(*self.center)
        b = dot(oc, direction)
        discriminant = b * b - (dot(oc, oc) - np.float32(self.radius**2))
        with np.errstate(invalid="ignore"):
            root = np.sqrt(discriminant)
            near, far = -b - root, -b + root
            t = np.where(near > NEAR, near, far)
            return np.where(t > NEAR, t, np.float32(np.inf))

    def normal(self, points: np.ndarray) -> np.ndarray:
        n = (points - _make_column(*self.center)) / np.float32(self.radius)
        return -n if self.inside else n


@dataclass(frozen=True)
class Torus:
    """A torus around an axis, found by sphere tracing of its exact distance function within its bounding sphere."""

    center: tuple[float, float, float]
    axis: tuple[float, float, float]
    radius: float
    tube: float

    def _locate_points(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return offset from the centre (3, R), height over the torus' plane (R,) and distance from its axis (R,)."""
        offset = points - _make_column(*self.center)
        height = dot(offset, normalize(_make_column(*self.axis)))
        return offset, height, np.sqrt(np.maximum(dot(offset, offset) - height * height, np.float32(1e-12)))

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return signed distances (R,) of points (3, R) from the surface."""
        _, height, ring = self._locate_points(points)
        return np.hypot(ring - np.float32(self.radius), height) - np.float32(self.tube)

    def intersect(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return the distance (R,) along each ray to the torus, in steps that the distance to its surface allows."""
        bound = self.radius + self.tube
        oc = origin - _make_column(*self.center)
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
        offset, height, ring = self._locate_points(points)
        axis = normalize(_make_column(*self.axis))
        ring_point = (offset - height * axis) * (np.float32(self.radius) / ring)
        return normalize(offset - ring_point)


@dataclass(frozen=True)
class Box:
    """An upright box, turned about the vertical axis by `turn` radians; `half` are its half sizes."""

    center: tuple[float, float, float]
    half: tuple[float, float, float]
    turn: float

    def _turn_vectors(self, v: np.ndarray, sign: int = 1) -> np.ndarray:
        """Vectors (3, R) in the box's own frame; with the sign -1 back to the world's."""
        c, s = np.float32(np.cos(self.turn)), np.float32(sign * np.sin(self.turn))
        return np.stack([c * v[0] - s * v[2], v[1], s * v[0] + c * v[2]])

    def local(self, points: np.ndarray) -> np.ndarray:
        """Return points (3, R) in the box's own frame, in units of its half sizes: the surface is at max |.| = 1."""
        return self._turn_vectors(points - _make_column(*self.center)) / _make_column(*self.half)

    def intersect(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return the distance (R,) along each ray to the box, also from inside."""
        o = self._turn_vectors(origin - _make_column(*self.center))
        d = self._turn_vectors(direction)
        half = _make_column(*self.half)
        with np.errstate(divide="ignore", invalid="ignore"):
            middle, reach = -o / d, np.abs(half / d)
            enter = (middle - reach).max(axis=0)
            leave = (middle + reach).min(axis=0)
            t = np.where(enter > NEAR, enter, leave)
            return np.where((leave >= enter) & (t > NEAR), t, np.float32(np.inf))

    def normal(self, points: np.ndarray) -> np.ndarray:
        """Return the unit normals (3, R) of the faces on which points (3, R) of the surface lie."""
        q = self.local(points)
        face = np.argmax(np.abs(q), axis=0)
        index = np.arange(q.shape[1])
        n = np.zeros_like(q)
        n[face, index] = np.sign(q[face, index])
        return self._turn_vectors(n, -1)


Shape = Ground | Sphere | Torus | Box


@dataclass(frozen=True)
class Thing:
    """One object: its shape, its diffuse texture, and how glossy it is."""

    shape: Shape
    texture: Texture
    mirror: float = 0.0  # reflectance at normal incidence (Schlick's F0); 0 = matt
    highlight: float = 0.0  # strength of the sun's highlight
    exponent: float = 40.0  # Blinn-Phong exponent of that highlight
    emissive: bool = False  # true for the backdrop, which is shown as painted, without light and shadow


def _mix(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> np.ndarray:
    return a + (b - a) * weight


def _soften_edge(x: np.ndarray, softness: float) -> np.ndarray:
    """Return a step at zero, softened over +-softness."""
    s = np.clip(x / np.float32(2 * softness) + np.float32(0.5), 0, 1)
    return s * s * (3 - 2 * s)


def _make_waves(p: np.ndarray, frequency: float, seed: int, count: int = 6) -> np.ndarray:
    """Return smooth band-limited noise (R,) in [-1, 1], the mean of plane waves of random direction and phase."""
    rng = np.random.default_rng(seed)
    total = np.zeros(p.shape[1], np.float32)
    for _ in range(count):
        k = rng.normal(size=3)
        k *= frequency * rng.uniform(0.6, 1.4) / np.linalg.norm(k)
        total += np.sin(np.float32(k[0]) * p[0] + np.float32(k[1]) * p[1] + np.float32(k[2]) * p[2] + rng.uniform(0, 7))
    return total / np.float32(count)


def ground_texture(p: np.ndarray) -> np.ndarray:
    """Return mottled two-tone tiles with soft seams, which fade to plain sand away from the middle."""
    tile = np.float32(np.pi / 0.55)
    check = _soften_edge(np.sin(tile * p[0]) * np.sin(tile * p[2]), 0.25)
    colour = _mix(_make_column(0.72, 0.63, 0.50), _make_column(0.34, 0.42, 0.46), check)
    colour = _mix(_make_column(0.62, 0.58, 0.50), colour, _soften_edge(np.float32(2.6) - np.hypot(p[0], p[2]), 0.5))
    return colour * (1 + np.float32(0.45) * _make_waves(p, 5.0, 1) + np.float32(0.25) * _make_waves(p, 17.0, 2))


def backdrop_texture(p: np.ndarray) -> np.ndarray:
    """Return a sky from haze to blue with broad soft clouds."""
    up = np.clip(-p[1] / np.float32(9), 0, 1)
    colour = _mix(_make_column(0.86, 0.84, 0.80), _make_column(0.36, 0.54, 0.80), np.sqrt(up))
    return _mix(colour, _make_column(0.95, 0.95, 0.96), _soften_edge(_make_waves(p, 0.9, 3), 0.5) * np.float32(0.6))


def stripes(axis: int, frequency: float, light: np.ndarray, dark: np.ndarray) -> Texture:
    """Make a texture of soft, slightly wavy stripes along a world axis."""

    def texture(p: np.ndarray) -> np.ndarray:
        phase = np.float32(frequency) * p[axis] + np.float32(0.8) * _make_waves(p, 6.0, 4)
        return _mix(light, dark, _soften_edge(np.sin(phase), 0.35))

    return texture


def marble(light: np.ndarray, dark: np.ndarray, seed: int) -> Texture:
    """Make a texture with veins of one colour in another."""

    def texture(p: np.ndarray) -> np.ndarray:
        vein = np.abs(_make_waves(p, 7.0, seed) + np.float32(0.4) * _make_waves(p, 19.0, seed + 1))
        return _mix(dark, light, _soften_edge(vein - np.float32(0.12), 0.12))

    return texture


def panels(box: Box) -> Texture:
    """Make a texture with a frame around each face of a box and a mottled filling."""

    def texture(p: np.ndarray) -> np.ndarray:
        q = np.sort(np.abs(box.local(p)), axis=0)
        frame = _soften_edge(q[1] - np.float32(0.78), 0.08)
        filling = _mix(
            _make_column(0.75, 0.32, 0.20), _make_column(0.90, 0.66, 0.30), _soften_edge(_make_waves(p, 12.0, 5), 0.4)
        )
        return _mix(filling, _make_column(0.22, 0.16, 0.14), frame)

    return texture


def ring_stripes(torus: Torus, count: int, light: np.ndarray, dark: np.ndarray) -> Texture:
    """Make a texture of bands around the tube of a tilted torus."""
    axis = np.asarray(torus.axis, np.float64) / np.linalg.norm(torus.axis)
    first = np.cross(axis, (0.31, 0.77, 0.55))
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)

    def texture(p: np.ndarray) -> np.ndarray:
        offset = p - _make_column(*torus.center)
        angle = np.arctan2(second.astype(np.float32) @ offset, first.astype(np.float32) @ offset)
        return _mix(light, dark, _soften_edge(np.sin(np.float32(count) * angle), 0.3))

    return texture


def demo_scene() -> list[Thing]:
    """Make a tiled ground under a painted sky with three spheres, of which two are glossy, a torus and a box.

    Up is -y.
    """
    torus = Torus((-0.15, -0.62, 0.95), (0.35, -0.55, 0.75), 0.42, 0.16)
    box = Box((0.95, -0.38, 0.55), (0.30, 0.38, 0.30), 0.5)
    return [
        Thing(Sphere((0, 0, 0), 9.0, inside=True), backdrop_texture, emissive=True),
        Thing(Ground(9.0), ground_texture),
        Thing(
            Sphere((-0.95, -0.55, -0.15), 0.55),
            stripes(1, 14.0, _make_column(0.80, 0.20, 0.16), _make_column(0.92, 0.82, 0.66)),
            mirror=0.05,
            highlight=0.5,
            exponent=50,
        ),
        Thing(
            Sphere((0.30, -0.42, -0.75), 0.42),
            marble(_make_column(0.16, 0.45, 0.52), _make_column(0.80, 0.88, 0.85), 6),
            mirror=0.16,
            highlight=0.35,
            exponent=25,
        ),
        Thing(
            Sphere((1.25, -0.24, -0.55), 0.24),
            marble(_make_column(0.42, 0.55, 0.22), _make_column(0.75, 0.80, 0.40), 8),
        ),
        Thing(
            torus, ring_stripes(torus, 9, _make_column(0.93, 0.78, 0.28), _make_column(0.25, 0.22, 0.42)), highlight=0.4
        ),
        Thing(box, panels(box)),
    ]
