"""Objects of the demo scene: shapes with textures and finish.

A texture is a function from surface points (3, R) to diffuse colours (3, R) in [0, 1]. All textures are smooth or
soft-edged at the scale of a pixel, so that supersampling is enough against aliasing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from demo.shapes import Box, Ground, Shape, Sphere, Torus

Texture = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Thing:
    """One object: its shape, its diffuse texture, and how glossy it is."""

    shape: Shape
    texture: Texture
    mirror: float = 0.0  # reflectance at normal incidence (Schlick's F0); 0 = matt
    highlight: float = 0.0  # strength of the sun's highlight
    exponent: float = 40.0  # Blinn-Phong exponent of that highlight
    emissive: bool = False  # true for the backdrop, which is shown as painted, without light and shadow


def _rgb(*values: float) -> np.ndarray:
    return np.asarray(values, np.float32).reshape(3, 1)


def _mix(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> np.ndarray:
    return a + (b - a) * weight


def _edge(x: np.ndarray, softness: float) -> np.ndarray:
    """Return a step at zero, softened over +-softness."""
    s = np.clip(x / np.float32(2 * softness) + np.float32(0.5), 0, 1)
    return s * s * (3 - 2 * s)


def _waves(p: np.ndarray, frequency: float, seed: int, count: int = 6) -> np.ndarray:
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
    check = _edge(np.sin(tile * p[0]) * np.sin(tile * p[2]), 0.25)
    colour = _mix(_rgb(0.72, 0.63, 0.50), _rgb(0.34, 0.42, 0.46), check)
    colour = _mix(_rgb(0.62, 0.58, 0.50), colour, _edge(np.float32(2.6) - np.hypot(p[0], p[2]), 0.5))
    return colour * (1 + np.float32(0.45) * _waves(p, 5.0, 1) + np.float32(0.25) * _waves(p, 17.0, 2))


def backdrop_texture(p: np.ndarray) -> np.ndarray:
    """Return a sky from haze to blue with broad soft clouds."""
    up = np.clip(-p[1] / np.float32(9), 0, 1)
    colour = _mix(_rgb(0.86, 0.84, 0.80), _rgb(0.36, 0.54, 0.80), np.sqrt(up))
    return _mix(colour, _rgb(0.95, 0.95, 0.96), _edge(_waves(p, 0.9, 3), 0.5) * np.float32(0.6))


def stripes(axis: int, frequency: float, light: np.ndarray, dark: np.ndarray) -> Texture:
    """Make a texture of soft, slightly wavy stripes along a world axis."""

    def texture(p: np.ndarray) -> np.ndarray:
        phase = np.float32(frequency) * p[axis] + np.float32(0.8) * _waves(p, 6.0, 4)
        return _mix(light, dark, _edge(np.sin(phase), 0.35))

    return texture


def marble(light: np.ndarray, dark: np.ndarray, seed: int) -> Texture:
    """Make a texture with veins of one colour in another."""

    def texture(p: np.ndarray) -> np.ndarray:
        vein = np.abs(_waves(p, 7.0, seed) + np.float32(0.4) * _waves(p, 19.0, seed + 1))
        return _mix(dark, light, _edge(vein - np.float32(0.12), 0.12))

    return texture


def panels(box: Box) -> Texture:
    """Make a texture with a frame around each face of a box and a mottled filling."""

    def texture(p: np.ndarray) -> np.ndarray:
        q = np.sort(np.abs(box.local(p)), axis=0)
        frame = _edge(q[1] - np.float32(0.78), 0.08)
        filling = _mix(_rgb(0.75, 0.32, 0.20), _rgb(0.90, 0.66, 0.30), _edge(_waves(p, 12.0, 5), 0.4))
        return _mix(filling, _rgb(0.22, 0.16, 0.14), frame)

    return texture


def ring_stripes(torus: Torus, count: int, light: np.ndarray, dark: np.ndarray) -> Texture:
    """Make a texture of bands around the tube of a tilted torus."""
    axis = np.asarray(torus.axis, np.float64) / np.linalg.norm(torus.axis)
    first = np.cross(axis, (0.31, 0.77, 0.55))
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)

    def texture(p: np.ndarray) -> np.ndarray:
        offset = p - np.asarray(torus.center, np.float32).reshape(3, 1)
        angle = np.arctan2(second.astype(np.float32) @ offset, first.astype(np.float32) @ offset)
        return _mix(light, dark, _edge(np.sin(np.float32(count) * angle), 0.3))

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
            stripes(1, 14.0, _rgb(0.80, 0.20, 0.16), _rgb(0.92, 0.82, 0.66)),
            mirror=0.05,
            highlight=0.5,
            exponent=50,
        ),
        Thing(
            Sphere((0.30, -0.42, -0.75), 0.42),
            marble(_rgb(0.16, 0.45, 0.52), _rgb(0.80, 0.88, 0.85), 6),
            mirror=0.16,
            highlight=0.35,
            exponent=25,
        ),
        Thing(Sphere((1.25, -0.24, -0.55), 0.24), marble(_rgb(0.42, 0.55, 0.22), _rgb(0.75, 0.80, 0.40), 8)),
        Thing(torus, ring_stripes(torus, 9, _rgb(0.93, 0.78, 0.28), _rgb(0.25, 0.22, 0.42)), highlight=0.4),
        Thing(box, panels(box)),
    ]
