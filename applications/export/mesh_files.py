"""Files of meshes: PLY with colours; GLB (binary glTF 2.0), OBJ and USDZ with textures.

GLB and USDZ have y up by a node that turns them, and OBJ has it in its vertices: programs expect it there. PLY has the
axes of the model, or z up where it is known what is up: PLY has no convention, and Blender takes z.
"""

from __future__ import annotations

import io
import os
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image
from plyfile import PlyData, PlyElement

from applications.export.scene_formats import find_pxr, georeference, write_binary_gltf, write_usd_package
from groundwork.files.ours import refuse_foreign, write_picture
from groundwork.host.listing import as_utf8
from scene.gaussians.ply import frame_comments
from scene.splats.splats import Splats
from utils.system_utils import UserError, atomic_write

if TYPE_CHECKING:  # which needs SciPy
    from types import ModuleType

    from applications.export.mesh import Mesh

PACKAGES = {"skimage": "scikit-image", "fast_simplification": "fast-simplification", "xatlas": "xatlas"}
_COLORS = ("red", "green", "blue")
_UNLIT = "KHR_materials_unlit"  # as the colours are those of photos
_VERTICES, _INDICES = 34962, 34963  # targets of buffer views
_FLOAT, _UNSIGNED_INT = 5126, 5125
_QUALITY = 92  # of JPEG


def find_packages(path: str | os.PathLike) -> None:
    """UserError without the packages that a mesh needs."""
    for module, package in PACKAGES.items():
        try:
            import_module(module)
        except ImportError as error:
            raise UserError(f"{path} needs the package {package}; run pip install '.[export]'") from error


def turn_z_up(mesh: Mesh) -> Mesh:
    """A mesh with z up instead of -y. Where x was east and z north, x is east, y north and z up."""
    (x, y, z), (to_x, to_y, to_z) = mesh.vertices.T, mesh.normals.T
    return replace(mesh, vertices=np.stack([x, z, -y], axis=1), normals=np.stack([to_x, to_z, -to_y], axis=1))


def write_ply_mesh(path: str | os.PathLike, mesh: Mesh, splats: Splats) -> None:
    """Write a PLY, whole or not at all. splats: those of the mesh, whose frame its comments tell."""
    floats = ("x", "y", "z", "nx", "ny", "nz")
    vertices = np.empty(len(mesh.vertices), [*((axis, "<f4") for axis in floats), *((c, "u1") for c in _COLORS)])
    columns = *mesh.vertices.T, *mesh.normals.T, *mesh.colors.T
    for column, values in zip(vertices.dtype.names, columns, strict=True):
        vertices[column] = values
    faces = np.empty(len(mesh.faces), [("vertex_indices", "<i4", (3,))])
    faces["vertex_indices"] = mesh.faces
    elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
    comments = frame_comments(splats.world_offset, splats.enlargement)
    with atomic_write(path) as temporary:
        PlyData(elements, byte_order="<", comments=comments).write(str(temporary))


def write_glb_mesh(path: str | os.PathLike, mesh: Mesh, splats: Splats) -> None:
    """Write a GLB, whole or not at all. UserError if it is too large. splats: those of the mesh, with its place."""
    picture = _encode_jpeg(mesh)
    arrays = {
        "POSITION": mesh.vertices.astype("<f4"),
        "NORMAL": mesh.normals.astype("<f4"),
        "TEXCOORD_0": mesh.uv.astype("<f4"),
        "indices": mesh.faces.astype("<u4"),
        "picture": np.frombuffer(picture + b"\0" * (-len(picture) % 4), np.uint8),
    }
    starts = np.cumsum([0, *(values.nbytes for values in arrays.values())]).tolist()
    views = [
        {"buffer": 0, "byteOffset": start, "byteLength": values.nbytes}
        for start, values in zip(starts, arrays.values(), strict=False)
    ]
    for view, target in zip(views, (_VERTICES, _VERTICES, _VERTICES, _INDICES), strict=False):
        view["target"] = target
    views[-1]["byteLength"] = len(picture)
    accessors = [
        {"bufferView": index, "componentType": _FLOAT, "count": len(mesh.vertices), "type": name}
        for index, name in enumerate(("VEC3", "VEC3", "VEC2"))
    ]
    accessors[0] |= {"min": mesh.vertices.min(axis=0).tolist(), "max": mesh.vertices.max(axis=0).tolist()}
    accessors.append({"bufferView": 3, "componentType": _UNSIGNED_INT, "count": mesh.faces.size, "type": "SCALAR"})
    surface = {"baseColorTexture": {"index": 0}, "metallicFactor": 0}
    attributes = {name: index for index, name in enumerate(arrays) if index < 3}
    document = {
        "asset": {"version": "2.0", "generator": "export.py"},
        "extensionsUsed": [_UNLIT],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "mesh", "rotation": [1, 0, 0, 0], "mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 3, "material": 0}]}],
        "materials": [{"extensions": {_UNLIT: {}}, "pbrMetallicRoughness": surface, "doubleSided": True}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 4, "mimeType": "image/jpeg"}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": starts[-1]}],
    }
    georeference(document, splats.place)
    write_binary_gltf(path, document, arrays.values(), "give fewer --triangles")


def _encode_jpeg(mesh: Mesh) -> bytes:
    """Return the texture of a mesh as a JPEG file."""
    content = io.BytesIO()
    Image.fromarray(mesh.texture).save(content, "JPEG", quality=_QUALITY, subsampling=0)
    return content.getvalue()


def check_obj_mesh(path: str | os.PathLike) -> None:
    """UserError without what an OBJ needs, or for foreign files in the way of those beside it."""
    find_packages(path)
    if as_utf8(name := Path(path).stem) != name:
        raise UserError(
            f"an OBJ names the files beside it in UTF-8, which “{as_utf8(name)}” is not; choose another --to"
        )
    refuse_foreign(Path(path).with_suffix(".png"))
    material = Path(path).with_suffix(".mtl")
    if os.path.lexists(material) and not (
        material.is_file() and material.read_text("utf-8", "replace") == _format_material(path)
    ):
        raise UserError(f"no export wrote {material}, and this one would replace it; move it, or choose another --to")


def _format_material(path: str | os.PathLike) -> str:
    """Return the text of an MTL file whose texture is the PNG beside the mesh. path: of the mesh."""
    return f"newmtl mesh\nKd 1 1 1\nillum 0\nmap_Kd {Path(path).stem}.png\n"


def write_obj_mesh(path: str | os.PathLike, mesh: Mesh, splats: Splats) -> None:
    """Write an OBJ, and beside it its material and its texture, each whole or not at all."""
    write_picture(Path(path).with_suffix(".png"), Image.fromarray(mesh.texture))
    with atomic_write(Path(path).with_suffix(".mtl")) as temporary:
        temporary.write_text(_format_material(path), encoding="utf-8")
    with atomic_write(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
        file.write(f"mtllib {Path(path).stem}.mtl\nusemtl mesh\n")
        turn = np.float32([1, -1, -1])
        np.savetxt(file, mesh.vertices * turn, "v %.7g %.7g %.7g")
        np.savetxt(file, mesh.normals * turn, "vn %.4f %.4f %.4f")
        np.savetxt(file, [0, 1] + mesh.uv * [1, -1], "vt %.6f %.6f")
        np.savetxt(file, np.repeat(mesh.faces + 1, 3, axis=1), "f" + " %d/%d/%d" * 3)


def write_usdz_mesh(path: str | os.PathLike, mesh: Mesh, splats: Splats) -> None:
    """Write a USDZ, whole or not at all."""

    def fill(usd: ModuleType, stage: object, folder: Path) -> None:
        (folder / "texture.jpg").write_bytes(_encode_jpeg(mesh))
        vt, geom = usd.Vt, usd.UsdGeom
        shape = geom.Mesh.Define(stage, "/World/Mesh")
        geom.Xformable(shape).AddRotateXOp().Set(180.0)
        shape.CreatePointsAttr(vt.Vec3fArray.FromNumpy(mesh.vertices))
        shape.CreateNormalsAttr(vt.Vec3fArray.FromNumpy(mesh.normals))
        shape.SetNormalsInterpolation(geom.Tokens.vertex)
        shape.CreateFaceVertexCountsAttr(vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
        shape.CreateFaceVertexIndicesAttr(vt.IntArray.FromNumpy(mesh.faces.ravel()))
        shape.CreateSubdivisionSchemeAttr(geom.Tokens.none)
        shape.CreateDoubleSidedAttr(True)
        bounds = np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)])
        shape.CreateExtentAttr(vt.Vec3fArray.FromNumpy(bounds))
        uv = np.float32([0, 1]) + mesh.uv * np.float32([1, -1])
        st = geom.PrimvarsAPI(shape).CreatePrimvar("st", usd.Sdf.ValueTypeNames.TexCoord2fArray, geom.Tokens.vertex)
        st.Set(vt.Vec2fArray.FromNumpy(uv))
        _bind_texture(usd, stage, shape, "texture.jpg")

    write_usd_package(path, fill)


def _bind_texture(usd: ModuleType, stage: object, shape: object, picture: str) -> None:
    """Let a mesh have the colours of a picture, by its `st`, whatever the light."""
    shade, kinds = usd.UsdShade, usd.Sdf.ValueTypeNames
    material = shade.Material.Define(stage, "/World/Material")
    shaders = {name: shade.Shader.Define(stage, f"/World/Material/{name}") for name in ("Surface", "Texture", "Places")}
    names = ("UsdPreviewSurface", "UsdUVTexture", "UsdPrimvarReader_float2")
    for shader, name in zip(shaders.values(), names, strict=True):
        shader.CreateIdAttr(name)
    surface, texture, places = shaders.values()
    places.CreateInput("varname", kinds.String).Set("st")
    texture.CreateInput("file", kinds.Asset).Set(picture)
    texture.CreateInput("sourceColorSpace", kinds.Token).Set("sRGB")
    where = places.CreateOutput("result", kinds.Float2)
    texture.CreateInput("st", kinds.Float2).ConnectToSource(where)
    color = texture.CreateOutput("rgb", kinds.Float3)
    surface.CreateInput("diffuseColor", kinds.Color3f).Set((0.0, 0.0, 0.0))
    surface.CreateInput("emissiveColor", kinds.Color3f).ConnectToSource(color)
    surface.CreateInput("roughness", kinds.Float).Set(1.0)
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    shade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(material)


def check_usdz_mesh(path: str | os.PathLike) -> None:
    """UserError without what a USDZ of a mesh needs."""
    find_packages(path)
    find_pxr(path)
