"""point_cloud.ply: the trained model as other tools read it, with the columns and order of the reference."""

import os
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from plyfile import PlyData, PlyParseError
from torch import Tensor

from utils.system_utils import UserError, atomic_write


class GaussianRows(NamedTuple):
    """Raw parameters of N Gaussians, float32: what the file holds, before any activation."""

    xyz: Tensor  # (N, 3) world units
    features_dc: Tensor  # (N, 1, 3) SH band 0, RGB last
    features_rest: Tensor  # (N, K, 3) the other bands, K = (degree + 1)^2 - 1
    opacity: Tensor  # (N, 1) logit
    scaling: Tensor  # (N, 3) natural logarithm of world units
    rotation: Tensor  # (N, 4) quaternion w x y z, any length


def _names(bands: int) -> dict[str, list[str]]:
    """Column names of each part of the file, in file order, for `bands` SH coefficients above band 0."""
    return {
        "xyz": ["x", "y", "z"],
        "normal": ["nx", "ny", "nz"],
        "features_dc": [f"f_dc_{i}" for i in range(3)],
        "features_rest": [f"f_rest_{i}" for i in range(3 * bands)],
        "opacity": ["opacity"],
        "scaling": [f"scale_{i}" for i in range(3)],
        "rotation": [f"rot_{i}" for i in range(4)],
    }


def write_ply(path: str | os.PathLike, rows: GaussianRows) -> None:
    """Write a binary little-endian PLY, float32, SH bands channel by channel; the whole file or none."""
    count, bands = rows.features_rest.shape[:2]
    names = _names(bands)
    matrix = np.zeros((count, sum(map(len, names.values()))), dtype="<f4")
    start = 0
    for part, columns in names.items():
        if part != "normal":
            values = getattr(rows, part)
            if values.dim() == 3:
                values = values.transpose(1, 2)
            matrix[:, start : start + len(columns)] = values.reshape(count, len(columns)).cpu().numpy()
        start += len(columns)
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property float {name}" for part in names.values() for name in part]
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join([*header, "end_header\n"]).encode("ascii"))
        matrix.tofile(file)


def read_ply(path: str | os.PathLike, sh_degree: int) -> GaussianRows:
    """Read a Gaussian PLY of exactly this SH degree, ours or another tool's: any order, scalar type and encoding.

    UserError when the file can't be had or read, lacks properties (names them), or has another degree.
    """
    vertices = _read_vertices(path)
    present = set(vertices.dtype.names or ())
    bands = (sh_degree + 1) ** 2 - 1
    rest = sum(name.startswith("f_rest_") for name in present)
    names = _names(bands)
    del names["normal"]
    missing = [name for part, columns in names.items() if part != "features_rest" for name in columns]
    missing = [name for name in missing if name not in present]
    if missing:
        raise UserError(
            f"{path} is no Gaussian model, it lacks the properties {', '.join(missing)}; give a trained one"
        )
    if rest != 3 * bands or not present.issuperset(names["features_rest"]):
        degree = next((d for d in range(4) if 3 * ((d + 1) ** 2 - 1) == rest), None)
        found = "no SH degree that is known" if degree is None else f"SH degree {degree}"
        raise UserError(
            f"{path} has {rest} f_rest properties, that is {found}, where SH degree {sh_degree} needs {3 * bands}; "
            "give the --sh_degree of the file"
        )
    parts = dict(zip(names, _columns(vertices, list(names.values())), strict=True))
    count = len(vertices)
    return GaussianRows(
        xyz=parts["xyz"],
        features_dc=parts["features_dc"].reshape(count, 1, 3),
        features_rest=parts["features_rest"].reshape(count, 3, bands).transpose(1, 2).contiguous(),
        opacity=parts["opacity"],
        scaling=parts["scaling"],
        rotation=parts["rotation"],
    )


def _read_vertices(path: str | os.PathLike) -> np.ndarray:
    """The structured array of the element `vertex`."""
    if not os.path.isfile(path):
        raise UserError(f"no file {path}; give the point_cloud.ply of a trained model")
    try:
        return PlyData.read(os.fspath(path))["vertex"].data
    except (PlyParseError, ValueError, UnicodeDecodeError) as error:
        raise UserError(f"{path} is not a whole PLY file ({error}); make or fetch it again") from error
    except KeyError as error:
        raise UserError(f"{path} has no element 'vertex', so it is no Gaussian model; give a trained one") from error


def _columns(vertices: np.ndarray, parts: list[list[str]]) -> Iterator[Tensor]:
    """(N, len(part)) float32 for each list of names."""
    kinds = {vertices.dtype[name] for name in vertices.dtype.names}
    if kinds == {np.dtype("<f4")} and vertices.dtype.itemsize == 4 * len(vertices.dtype.names):
        # One float table: picking columns of it is many times faster than field by field.
        table = np.asarray(vertices).view("<f4").reshape(len(vertices), len(vertices.dtype.names))
        position = {name: i for i, name in enumerate(vertices.dtype.names)}
        for part in parts:
            yield torch.from_numpy(table[:, [position[name] for name in part]])
        return
    for part in parts:
        matrix = np.empty((len(vertices), len(part)), dtype=np.float32)
        for i, name in enumerate(part):
            matrix[:, i] = vertices[name]
        yield torch.from_numpy(matrix)
