"""Splats for tests of exports: random ones, such with extreme values, and very many in a file of few bytes."""

import gzip
import json
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree

from applications.export.formats import find_format
from scene.splats.splats import Splats, tidy

COUNT, FAR = 2000, 7  # splats of `cube`, and the number of the one that lies apart
_PACKAGES = {".spz": "zstandard", ".usdz": "pxr"}


def written(folder: Path, ending: str, some: Splats, name: str = "model") -> Path:
    """The file of some splats in the format of an ending; skips without the package that it needs."""
    if ending in _PACKAGES:
        pytest.importorskip(_PACKAGES[ending], reason="the extra [export] is not installed")
    path = folder / (name + ending)
    find_format(path).write(path, some)
    return path


def read_glb(path: Path) -> tuple[dict, bytes]:
    """The document of a GLB file and its binary chunk."""
    content = path.read_bytes()
    magic, version, length, size = struct.unpack_from("<4sIII", content)
    assert (magic, version, length) == (b"glTF", 2, len(content))
    return json.loads(content[20 : 20 + size]), content[28 + size :]


def splats(count: int, degree: int = 3, seed: int = 0, antialiasing: bool = False) -> Splats:
    """Random splats: positions within some units, scales about 0.02, SH coefficients above band 0 about 0.1."""
    random = np.random.default_rng(seed)

    def normal(*shape: int, mean: float = 0.0, size: float = 1.0) -> np.ndarray:
        return random.normal(mean, size, shape).astype(np.float32)

    sh = normal(count, (degree + 1) ** 2, 3, size=0.1)
    sh[:, 0] *= 5
    means, scales, rotations = normal(count, 3), normal(count, 3, mean=-4), normal(count, 4)
    return tidy(Splats(means, scales, rotations, normal(count, size=2), sh, antialiasing))


def extreme_splats(degree: int = 3) -> Splats:
    """Splats at the ends of what a float32 model may hold."""
    some = splats(8, degree)
    some.log_scales[:] = np.float32([-80, -40, -20, -1, 0, 20, 40, 80])[:, None]
    some.opacity_logits[:] = np.float32([-np.inf, -200, -10, 0, 10, 200, np.inf, 1])
    some.means[:] *= np.float32([0, 1e-20, 1, 1, 1, 1e3, 1e5, 1e30])[:, None]
    some.sh[:] *= np.float32([0, 1e-20, 1, 1, 1, 100, 1e5, 1])[:, None, None]
    some.rotations[:4] = np.eye(4, dtype=np.float32)
    some.rotations[4:] = -np.eye(4, dtype=np.float32)
    return tidy(some)


def empty_spz(version: int, count: int, degree: int = 0) -> bytes:
    """An SPZ file of version 3 or 4 with splats that are all zero bits, which pack to a thousandth and less."""
    sizes = [9 * count, count, 3 * count, 3 * count, 4 * count, 3 * ((degree + 1) ** 2 - 1) * count]
    if version == 3:
        header = struct.pack("<IIIBBBB", 0x5053474E, 3, count, degree, 12, 0, 0)
        return gzip.compress(header) + b"".join(map(gzip.compress, _zeros(sum(sizes))))
    import zstandard

    packed = []
    for size in sizes[: 6 if degree else 5]:
        compressor = zstandard.ZstdCompressor().compressobj(size=size)
        packed.append(b"".join(map(compressor.compress, _zeros(size))) + compressor.flush())
    table = b"".join(struct.pack("<QQ", len(p), size) for p, size in zip(packed, sizes, strict=False))
    header = struct.pack("<IIIBBBBI12x", 0x5053474E, 4, count, degree, 12, 0, len(packed), 32)
    return header + table + b"".join(packed)


def _zeros(size: int) -> Iterator[bytes]:
    """Pieces of so many zero bytes."""
    return (bytes(min(1 << 20, size - begin)) for begin in range(0, size, 1 << 20))


def cube(x: float | None = None, color: float | None = None) -> Splats:
    """Splats in a cube of half size 1, of which one has another x or SH0."""
    random = np.random.default_rng(0)
    some = splats(COUNT, 0)
    some.means[:] = random.uniform(-1, 1, (COUNT, 3))
    some.opacity_logits[:] = 0
    if x is not None:
        some.means[FAR] = [x, 0, 0]
    if color is not None:
        some.sh[FAR] = color
    return some


def moved(some: Splats, read: Splats) -> np.ndarray:
    """(COUNT - 1,) how far each of the others is from the nearest splat that was read and is seen."""
    seen = read.means[read.opacity_logits > -5].astype(np.float64)
    assert len(seen) <= COUNT
    return KDTree(seen).query(np.delete(some.means, FAR, axis=0))[0]
