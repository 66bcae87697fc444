"""Files of meshes: PLY, and GLB (binary glTF 2.0) with y up by a node that turns it.

PLY has the axes of the model, or z up where it is known what is up: PLY has no convention, and Blender takes z.
"""

from __future__ import annotations

import os
from dataclasses import replace
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
from plyfile import PlyData, PlyElement

from scene.gaussians.ply import frame_comments
from scene.splats.splats import Splats
from splatting.exports.scene_formats import georeference, write_binary_gltf
from utils.system_utils import UserError, atomic_write

if TYPE_CHECKING:  # which needs SciPy
    from splatting.exports.mesh import Mesh

_COLORS = ("red", "green", "blue")
_UNLIT = "KHR_materials_unlit"  # as the colours are those of photos
_VERTICES, _INDICES = 34962, 34963  # targets of buffer views
_FLOAT, _UNSIGNED_BYTE, _UNSIGNED_INT = 5126, 5121, 5125


def find_skimage(path: str | os.PathLike) -> ModuleType:
    """The package that a mesh needs. UserError without it."""
    try:
        import skimage
    except ImportError as error:
        raise UserError(f"{path} needs the package scikit-image; run pip install '.[export]'") from error
    return skimage


def with_z_up(mesh: Mesh) -> Mesh:
    """A mesh with z up instead of -y. Where x was east and z north, x is east, y north and z up."""
    x, y, z = mesh.vertices.T
    return replace(mesh, vertices=np.stack([x, z, -y], axis=1))


def write_ply_mesh(path: str | os.PathLike, mesh: Mesh, splats: Splats) -> None:
    """Write a PLY, whole or not at all. splats: those of the mesh, whose frame its comments tell."""
    vertices = np.empty(len(mesh.vertices), [*((axis, "<f4") for axis in "xyz"), *((c, "u1") for c in _COLORS)])
    for column, values in zip(vertices.dtype.names, (*mesh.vertices.T, *mesh.colors.T), strict=True):
        vertices[column] = values
    faces = np.empty(len(mesh.faces), [("vertex_indices", "<i4", (3,))])
    faces["vertex_indices"] = mesh.faces
    elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
    comments = frame_comments(splats.world_offset, splats.enlargement)
    with atomic_write(path) as temporary:
        PlyData(elements, byte_order="<", comments=comments).write(str(temporary))


def write_glb_mesh(path: str | os.PathLike, mesh: Mesh, splats: Splats) -> None:
    """Write a GLB, whole or not at all. UserError if it is too large. splats: those of the mesh, with its place."""
    alpha = np.full((len(mesh.colors), 1), 255, np.uint8)
    arrays = {
        "POSITION": mesh.vertices.astype("<f4"),
        "COLOR_0": np.hstack([_linear(mesh.colors), alpha]),
        "indices": mesh.faces.astype("<u4"),
    }
    starts = np.cumsum([0, *(values.nbytes for values in arrays.values())]).tolist()
    targets, kinds = (_VERTICES, _VERTICES, _INDICES), (_FLOAT, _UNSIGNED_BYTE, _UNSIGNED_INT)
    position, color, indices = (
        {"bufferView": index, "componentType": kind, "count": len(values), "type": name}
        for index, (kind, values, name) in enumerate(
            zip(kinds, arrays.values(), ("VEC3", "VEC4", "SCALAR"), strict=True)
        )
    )
    position |= {"min": mesh.vertices.min(axis=0).tolist(), "max": mesh.vertices.max(axis=0).tolist()}
    color["normalized"], indices["count"] = True, mesh.faces.size
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}
    document = {
        "asset": {"version": "2.0", "generator": "export.py"},
        "extensionsUsed": [_UNLIT],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "mesh", "rotation": [1, 0, 0, 0], "mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"extensions": {_UNLIT: {}}, "pbrMetallicRoughness": {"metallicFactor": 0}, "doubleSided": True}],
        "accessors": [position, color, indices],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": values.nbytes, "target": target}
            for start, values, target in zip(starts, arrays.values(), targets, strict=False)
        ],
        "buffers": [{"byteLength": starts[-1]}],
    }
    georeference(document, splats.place)
    write_binary_gltf(path, document, arrays.values(), "give a larger --voxel")


def _linear(colors: np.ndarray) -> np.ndarray:
    """Light of sRGB colours (IEC 61966-2-1), both uint8: glTF's vertices have light."""
    values = colors / 255
    light = np.where(values > 0.04045, ((values + 0.055) / 1.055) ** 2.4, values / 12.92)
    return np.floor(255 * light + 0.5).astype(np.uint8)
