"""Coloured point clouds as PLY: `input.ply`, a scene's own points, `--init_pcd_path`."""

from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement, PlyParseError

from utils.graphics_utils import BasicPointCloud
from utils.system_utils import UserError, atomic_write

_POSITION = ("x", "y", "z")
_NORMAL = ("nx", "ny", "nz")
_COLOR = ("red", "green", "blue")


def read_point_cloud(path: Path) -> BasicPointCloud:
    """Points, colours (integers: fractions of their type's maximum) and normals (0 where not given) of a PLY.

    UserError for a file that is missing, no PLY, lacks x y z red green blue, or holds points that are not finite.
    """
    if not path.is_file():
        raise UserError(f"no point cloud {path}; give the path of a PLY file")
    try:
        ply = PlyData.read(str(path))
    except (PlyParseError, ValueError, OSError, EOFError, MemoryError) as error:
        raise UserError(f"{path} is not a readable PLY file ({error}); export the point cloud again") from error
    vertices = ply["vertex"].data if "vertex" in ply else np.zeros(0, dtype=[])
    names = vertices.dtype.names or ()
    missing = [name for name in _POSITION + _COLOR if name not in names]
    if missing:
        raise UserError(f"the point cloud {path} has no {', '.join(missing)}; it needs x y z red green blue per vertex")
    try:
        points = _columns(vertices, _POSITION)
        colors = np.stack([_fraction(vertices[name]) for name in _COLOR], axis=1)
        has_normals = all(name in names for name in _NORMAL)
        normals = _columns(vertices, _NORMAL) if has_normals else np.zeros_like(points)
    except (TypeError, ValueError) as error:
        raise UserError(f"the point cloud {path} has lists where numbers are needed; export it again") from error
    check_finite(points, path)
    if not ((colors >= 0) & (colors <= 1)).all():
        raise UserError(f"colours in {path} are neither integers nor between 0 and 1; save red green blue as uchar")
    return BasicPointCloud(points, colors, normals)


def check_finite(points: np.ndarray, path: Path) -> None:
    """UserError naming the first point (N,3) of a file that is not finite in float32."""
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        raise UserError(
            f"{bad.sum()} of {len(bad)} points in {path} are not finite (first: number {bad.argmax()}); remove them"
        )


def write_point_cloud(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
    """Write points (N,3), stored as float32, with colours (N,3) uint8 and zero normals, in the reference's layout."""
    columns = [(name, "<f4") for name in _POSITION + _NORMAL] + [(name, "u1") for name in _COLOR]
    vertices = np.zeros(len(points), dtype=columns)
    for index, name in enumerate(_POSITION):
        vertices[name] = points[:, index]
    for index, name in enumerate(_COLOR):
        vertices[name] = colors[:, index]
    with atomic_write(path) as temporary:
        PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write(str(temporary))


def _columns(vertices: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    with np.errstate(over="ignore"):  # becomes infinite, which check_finite reports
        return np.stack([vertices[name] for name in names], axis=1).astype(np.float32)


def _fraction(values: np.ndarray) -> np.ndarray:
    top = np.iinfo(values.dtype).max if np.issubdtype(values.dtype, np.integer) else 1.0
    return (values / top).astype(np.float32)
