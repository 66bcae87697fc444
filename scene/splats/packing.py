"""Packing of numbers into few bits, for all compressed formats."""

import numpy as np
import torch

from scene.gaussians.morton import morton_codes
from scene.splats.splats import Splats, base_colors, opacities


def pack(parts: np.ndarray, *bits: int) -> np.ndarray:
    """Values (N, K) in [0, 1] in K fields of so many bits, uint32 (N,); the first is highest, others are clamped."""
    codes = np.zeros(len(parts), np.uint32)
    for values, size in zip(parts.T, bits, strict=True):
        most = (1 << size) - 1
        rounded = np.floor(np.asarray(values, np.float64) * most + 0.5)
        codes = codes << np.uint32(size) | np.clip(rounded, 0, most).astype(np.uint32)
    return codes


def unpack(codes: np.ndarray, *bits: int) -> np.ndarray:
    """The values (N, K) in [0, 1] of `pack`, float64; bits above the fields do not count."""
    fields = []
    for size in reversed(bits):
        most = (1 << size) - 1
        fields.append((codes & np.uint32(most)) / most)
        codes = codes >> np.uint32(size)
    return np.stack(fields[::-1], axis=1)


def to_bytes(values: np.ndarray) -> np.ndarray:
    """Values in [0, 255] as uint8, rounded to the nearest; others are clamped."""
    rounded = values + 0.5
    np.floor(rounded, out=rounded)
    return np.clip(rounded, 0, 255, out=rounded).astype(np.uint8)


def rgba_bytes(splats: Splats) -> np.ndarray:
    """Colours of SH band 0 with opacities, (N, 4) uint8."""
    return to_bytes(255 * np.concatenate([base_colors(splats), opacities(splats)[:, None]], axis=1))


def morton_order(points: np.ndarray) -> np.ndarray:
    """Indices (N,) that put points (N, 3) along a Morton curve, so that neighbours in a file are near each other."""
    middle, _, scale = spread(points)
    return morton_codes(torch.from_numpy(points.astype(np.float64) - middle), scale).argsort(stable=True).numpy()


def spread(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """The middle (3,) of values (N, 3), their distances (N,) from it, and the usual distance; medians, float64.

    Values in the middle itself do not count for the usual distance, which is 1 if there are no others.
    """
    values = values.astype(np.float64)
    middle = np.median(values, axis=0) if len(values) else np.zeros(3)
    distances = np.linalg.norm(values - middle, axis=1)
    apart = distances[distances > 0]
    return middle, distances, float(np.median(apart)) if len(apart) else 1.0


def smallest_three(quaternions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index (N,) of the largest component of unit quaternions (N, 4), and the other three, in order, float64.

    The quaternion's sign is such that the largest is positive. The others are then within sqrt(1/2) of zero.
    """
    q = quaternions.astype(np.float64)
    largest = np.abs(q).argmax(axis=1)
    q = q * np.where(np.take_along_axis(q, largest[:, None], 1) < 0, -1.0, 1.0)
    return largest, q[np.arange(4) != largest[:, None]].reshape(-1, 3)


def whole_quaternions(largest: np.ndarray, three: np.ndarray) -> np.ndarray:
    """Unit quaternions (N, 4) of `smallest_three`."""
    q = np.empty((len(three), 4))
    q[np.arange(4) != largest[:, None]] = three.ravel()
    q[np.arange(len(q)), largest] = np.sqrt(np.clip(1 - (three**2).sum(axis=1), 0, 1))
    return q / np.linalg.norm(q, axis=1, keepdims=True)
