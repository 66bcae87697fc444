"""Float formats of general 3D programs: GLB (binary glTF 2.0) and USDZ. Both have linear scales, opacities and y up.

The values are those of the model, in COLMAP's axes. A node, or the prim, turns them half around x.

GLB has the Khronos extension KHR_gaussian_splatting: splats are points with attributes, float32, with quaternions xyzw,
and each SH coefficient as an attribute. COLOR_0 shows programs without the extension a coloured point cloud.

A compressed GLB has all of this as SPZ of version 2, by KHR_gaussian_splatting_compression_spz_2, a draft. CesiumJS
reads no other GLB of splats. SPZ has the axes of OpenGL, and band 0 and opacity are in COLOR_0 alone.

USDZ has the schema ParticleField3DGaussianSplat of OpenUSD 26.3 and later; SH coefficients lie splat by splat.
"""

import json
import os
import struct
import zipfile
from collections.abc import Callable, Collection
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from scene.splats.packing import rgba_bytes
from scene.splats.splats import Splats, half_rotated, opacities
from scene.splats.spz import packed_spz
from utils.system_utils import UserError, atomic_write, temporary_folder

EXTENSION = "KHR_gaussian_splatting"
COMPRESSION = "KHR_gaussian_splatting_compression_spz_2"
GEOREFERENCE = "EXT_georeference"
LARGEST = 2**32 - 1  # bytes of a GLB: the header has 32 bits for them
PRIM = "/World/Splats"
_FLOAT, _UNSIGNED_BYTE, _ARRAY_BUFFER, _POINTS = 5126, 5121, 34962, 0
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write_glb(path: str | os.PathLike, splats: Splats) -> None:
    """Write a GLB, whole or not at all. UserError if it is too large.

    Without splats it has a node without a mesh, as glTF has no empty one.
    """
    attributes = _list_attributes(splats) if len(splats) else {}
    document = _make_document(attributes, [values.nbytes for values in attributes.values()], splats.antialiasing)
    georeference(document, splats.place)
    write_binary_gltf(
        path, document, attributes.values(), "leave Gaussians out by --max_splats, or bands by --sh_degree"
    )


def write_compressed_glb(path: str | os.PathLike, splats: Splats) -> None:
    """Write a compressed GLB of one splat or more, whole or not at all. UserError for what it cannot hold."""
    packed = packed_spz(splats, 2)
    elsewhere = f"{EXTENSION}:OPACITY", f"{EXTENSION}:SH_DEGREE_0_COEF_0"
    attributes = {name: x for name, x in _list_attributes(half_rotated(splats)).items() if name not in elsewhere}
    document = _make_document(attributes, [len(packed)], splats.antialiasing)
    document["extensionsUsed"] = document["extensionsRequired"] = [EXTENSION, COMPRESSION]
    (primitive,) = document["meshes"][0]["primitives"]
    primitive["extensions"][EXTENSION]["extensions"] = {COMPRESSION: {"bufferView": 0}}
    for accessor in document["accessors"]:
        del accessor["bufferView"]
    del document["bufferViews"][0]["target"], document["nodes"][0]["rotation"]
    content = np.frombuffer(packed + b"\0" * (-len(packed) % 4), np.uint8)
    write_binary_gltf(path, document, [content], "leave Gaussians out by --max_splats, or bands by --sh_degree")


def georeference(document: dict, place: tuple[float, ...]) -> None:
    """Let the first node of a document tell where on Earth it is, by EXT_georeference, final draft of August 2026.

    Programs that know the extension put -x of the turned node to the east, y up and +z to the north; others show the
    same model, turned half around its vertical. EXIF data usually count heights from the sea level, and the extension
    from the ellipsoid, so the height, which is optional, is left out.

    place: latitude and longitude (degrees) and height (metres) of the model's origin; empty: nothing changes.
    """
    if not place:
        return
    node = document["nodes"][0]
    node["rotation"] = [0, 0, 1, 0]
    node["extensions"] = {GEOREFERENCE: {"latitude": place[0], "longitude": place[1]}}
    document["extensionsUsed"] = [*document.get("extensionsUsed", []), GEOREFERENCE]


def write_binary_gltf(
    path: str | os.PathLike, document: dict, arrays: Collection[np.ndarray], if_too_large: str
) -> None:
    """Write a document and the arrays of its one buffer, whole or not at all. UserError above LARGEST bytes.

    arrays: of sizes that are multiples of 4 bytes, one after another. if_too_large: the remedy.
    """
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    size = sum(values.nbytes for values in arrays)
    length = 12 + len(chunks) + (8 + size if arrays else 0)
    if length > LARGEST:
        raise UserError(
            f"{path} would have {length / 1e9:.1f} GB, and a GLB has at most {LARGEST / 1e9:.1f}; {if_too_large}"
        )
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, length) + chunks)
        if arrays:
            file.write(struct.pack("<I4s", size, b"BIN\0"))
        for values in arrays:  # one by one, as all of them together take much memory
            file.write(np.ascontiguousarray(values))


def _list_attributes(splats: Splats) -> dict[str, np.ndarray]:
    """Return the arrays (N, ...) of a GLB with splats, by glTF's name of the attribute."""
    values = {
        "POSITION": splats.means,
        "COLOR_0": rgba_bytes(splats),
        f"{EXTENSION}:ROTATION": np.roll(splats.rotations, -1, axis=1),
        f"{EXTENSION}:SCALE": np.exp(splats.log_scales),
        f"{EXTENSION}:OPACITY": opacities(splats)[:, None],
    }
    for degree in range(splats.sh_degree + 1):
        for index in range(2 * degree + 1):
            values[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{index}"] = splats.sh[:, degree**2 + index]
    return {name: x if x.dtype == np.uint8 else x.astype("<f4") for name, x in values.items()}


def _make_document(attributes: dict[str, np.ndarray], sizes: list[int], antialiasing: bool) -> dict:
    """Return the JSON part of a GLB.

    attributes: arrays by name, as `_list_attributes` returns them.
    sizes: bytes of each attribute in the binary part, in the order of `attributes`.
    antialiasing: true if the model was trained with it.
    """
    node = {"name": "splats", "rotation": [1, 0, 0, 0]}
    document = {
        "asset": {"version": "2.0", "generator": "export.py", "extras": {"antialiasing": antialiasing}},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
    }
    if not attributes:
        del document["extensionsUsed"]
        return document
    node["mesh"] = 0
    starts = np.cumsum([0, *sizes])
    settings = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {
        "mode": _POINTS,
        "attributes": {name: index for index, name in enumerate(attributes)},
        "extensions": {EXTENSION: settings},
    }
    return document | {
        "meshes": [{"primitives": [primitive]}],
        "accessors": [_make_accessor(index, name, values) for index, (name, values) in enumerate(attributes.items())],
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(start), "byteLength": size, "target": _ARRAY_BUFFER}
            for start, size in zip(starts, sizes, strict=False)
        ],
        "buffers": [{"byteLength": int(starts[-1])}],
    }


def _make_accessor(index: int, name: str, values: np.ndarray) -> dict:
    """Describe one attribute for glTF. index: number of its view of the buffer; values: (N, components)."""
    is_byte = values.dtype == np.uint8
    accessor = {
        "bufferView": index,
        "componentType": _UNSIGNED_BYTE if is_byte else _FLOAT,
        "count": len(values),
        "type": _KINDS[values.shape[1]],
    }
    if is_byte:
        accessor["normalized"] = True
    if name == "POSITION":  # glTF asks for its bounds
        accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
    return accessor


def write_usdz(path: str | os.PathLike, splats: Splats) -> None:
    """Write a USDZ file, whole or not at all. UserError without a usd-core that has the schema."""
    write_usd_package(path, lambda usd, stage, _: _add_splats(usd, stage, splats))


def write_usd_package(path: str | os.PathLike, fill: Callable[[ModuleType, Any, Path], None]) -> None:
    """Write a USDZ file, whole or not at all. UserError without usd-core.

    fill: takes pxr, a stage with y up, in metres and with the prim /World, and a folder for files that it refers to.
    """
    usd = find_pxr(path)
    with temporary_folder() as folder, atomic_write(path) as temporary:
        layer = folder / "model.usdc"
        try:
            stage = usd.Usd.Stage.CreateNew(str(layer))
            usd.UsdGeom.SetStageUpAxis(stage, usd.UsdGeom.Tokens.y)
            usd.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
            stage.SetDefaultPrim(usd.UsdGeom.Xform.Define(stage, "/World").GetPrim())
            fill(usd, stage, folder)
            stage.GetRootLayer().Save()
            done = usd.UsdUtils.CreateNewUsdzPackage(usd.Sdf.AssetPath(str(layer)), str(temporary))
        except usd.Tf.ErrorException:
            done = False
        if not done or not _is_complete(temporary):
            raise UserError(
                f"cannot write {path}; free space there and in {folder.parent}, fix the permissions, or choose "
                "another place"
            )
        _forget_time(temporary)


def _forget_time(package: Path) -> None:
    """Give the parts of a package the first date that ZIP has, so that the same model has the same bytes."""
    with zipfile.ZipFile(package) as archive:
        parts, place = archive.infolist(), archive.start_dir
    with open(package, "r+b") as file:
        for part in parts:
            for start in (part.header_offset + 10, place + 12):  # in the part's header, and in the directory
                file.seek(start)
                file.write(b"\0\0\x21\0")  # midnight, 1 January 1980
            file.seek(place + 28)
            place += 46 + sum(struct.unpack("<3H", file.read(6)))


def _is_complete(package: Path) -> bool:
    """Tell if a package has all of its bytes: OpenUSD raises no error when the disk is full."""
    try:
        with zipfile.ZipFile(package) as archive:
            return archive.testzip() is None
    except zipfile.BadZipFile:
        return False


def find_pxr(path: str | os.PathLike) -> ModuleType:
    """The package that a file of this name needs. UserError without it."""
    try:
        import pxr
        from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, UsdUtils, UsdVol, Vt  # noqa: F401  (so that pxr has them)

        UsdVol.ParticleField3DGaussianSplat  # noqa: B018
    except (ImportError, AttributeError) as error:
        reason = "needs the package usd-core, 26.3 or later"
        raise UserError(f"{path} {reason}; install it with pip install '.[export]'") from error
    return pxr


def _add_splats(usd: ModuleType, stage: Any, splats: Splats) -> None:
    """Add the prim with the splats to a USD stage. usd: the package `pxr`."""
    field = usd.UsdVol.ParticleField3DGaussianSplat.Define(stage, PRIM)
    usd.UsdGeom.Xformable(field).AddRotateXOp().Set(180.0)
    field.GetPrim().SetCustomDataByKey("antialiasing", bool(splats.antialiasing))
    vt = usd.Vt
    xyzw = np.ascontiguousarray(np.roll(splats.rotations, -1, axis=1))  # Gf keeps the real part last
    alpha = opacities(splats).astype(np.float32)
    values = {
        "positions": vt.Vec3fArray.FromNumpy(splats.means),
        "orientations": vt.QuatfArray.FromNumpy(xyzw),
        "scales": vt.Vec3fArray.FromNumpy(np.exp(splats.log_scales)),
        "opacities": vt.FloatArray.FromNumpy(alpha),
        "radiance:sphericalHarmonicsDegree": splats.sh_degree,
        "radiance:sphericalHarmonicsCoefficients": vt.Vec3fArray.FromNumpy(splats.sh.reshape(-1, 3)),
    }
    for name, value in values.items():
        field.GetPrim().GetAttribute(name).Set(value)
    # The kernel reaches three standard deviations; bounds let programs frame and cull the splats.
    bounds = np.zeros((2, 3), np.float32)
    if len(splats):
        reach = 3 * np.exp(splats.log_scales.max(axis=1, keepdims=True))
        bounds[:] = (splats.means - reach).min(axis=0), (splats.means + reach).max(axis=0)
    field.GetPrim().GetAttribute("extent").Set(vt.Vec3fArray.FromNumpy(bounds))
