"""3D Tiles 1.1 (OGC 22-025r4): tileset.json beside a folder of GLB with KHR_gaussian_splatting, for large models.

Those of three.js have float32, those of CesiumJS are compressed (applications/export/scene_formats.py).

A viewer draws the tiles of an octree that are as fine as the distance asks for, and loads no others. A GLB has y up,
and tiles have z up, so a viewer turns x y z of a GLB to x -z y. Boxes are in these axes. Where GPS is known, they are
east, north and up, and the root's transform places them on the globe.
"""

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from applications.export.levels import Tile, Views, build_octree, make_table
from applications.export.scene_formats import COMPRESSION, EXTENSION, write_compressed_glb, write_glb
from applications.export.side_files import PLACE, write_with_folder
from scene.splats.splats import Splats
from scene.splats.spz import warn_of_sizes

_EQUATOR, _FLATTENING = 6378137.0, 1 / 298.257223563  # of WGS 84: the radius in metres
_ANNOUNCED = "3DTILES_content_gltf"  # says ahead of loading which extensions GLB files use


def write_tileset(path: str | os.PathLike, splats: Splats, around: Views, compressed: bool = False) -> str:
    """Write a tileset, whole or not at all, print what each level loses, and return a part of a sentence about it.

    The files of an earlier tileset of this name go once the new one is there. compressed: for CesiumJS.
    """
    root, path, sizes = build_octree(splats), Path(path), {}
    write = write_compressed_glb if compressed else write_glb
    if compressed:
        warn_of_sizes([tile.splats for tile in root.all()])
    with write_with_folder(path, "tiles-") as folder:
        for tile in root.all():
            if len(tile.splats):
                write(folder / f"{tile.name}.glb", replace(tile.splats, place=()))  # which the root has
                sizes[tile.name] = (folder / f"{tile.name}.glb").stat().st_size
        (folder / path.name).write_text(
            json.dumps(make_document(root, PLACE, compressed), allow_nan=False), encoding="utf-8"
        )
    levels = [root.level(depth) for depth in range(root.levels)]
    print(make_table(root, [sum(sizes.get(tile.name, 0) for tile in level) for level in levels], around))
    return f"{root.levels} levels, {len(sizes)} tiles with {sum(sizes.values()) / 1e6:.2f} MB in a folder beside it"


def make_document(root: Tile, folder: str, compressed: bool = False) -> dict[str, Any]:
    """The content of tileset.json."""
    announced = {"extensionsUsed": [EXTENSION]}
    if compressed:  # CesiumJS takes tiles for splats where both are required
        announced = dict.fromkeys(("extensionsUsed", "extensionsRequired"), [EXTENSION, COMPRESSION])
    width = float(np.linalg.norm(root.high - root.low))
    transform = {"transform": place_on_globe(root.splats.place)} if root.splats.place else {}
    return {
        "asset": {"version": "1.1", "extras": {"generator": "export.py", "folder": folder}},
        "extensionsUsed": [_ANNOUNCED],
        "extensions": {_ANNOUNCED: announced},
        "geometricError": max(width, 2 * root.error),  # of a viewer that draws nothing
        "root": {"refine": "REPLACE", **transform, **_make_entry(root, folder)},
    }


def _make_entry(tile: Tile, folder: str) -> dict[str, Any]:
    """Return the entry of a tile and of the tiles below it. folder: of the GLB files, relative to tileset.json."""
    entry = {"boundingVolume": {"box": make_box(tile.low, tile.high)}, "geometricError": tile.error}
    if len(tile.splats):
        entry["content"] = {"uri": f"{folder}/{tile.name}.glb"}
    if tile.children:
        entry["children"] = [_make_entry(child, folder) for child in tile.children]
    return entry


def make_box(low: np.ndarray, high: np.ndarray) -> list[float]:
    """A boundingVolume's middle and half axes, 12 numbers in the axes of tiles, of corners (3,) in those of COLMAP.

    The GLB's node takes x y z to x -y -z, and the viewer that to x z -y.
    """
    middle, half = ((low + high) / 2)[[0, 2, 1]] * [1, 1, -1], ((high - low) / 2)[[0, 2, 1]]
    return [*middle.tolist(), *np.diag(half).ravel().tolist()]


def place_on_globe(place: tuple[float, ...]) -> list[float]:
    """Return the transform from metres east, north and up of a place to EPSG:4978: 16 numbers by columns.

    Formulas of geodetic coordinates: EPSG guidance note 7-2, 4.1.1. The height counts from the ellipsoid here, and in
    EXIF
    data usually from the sea level, which is up to 107 m away.

    place: latitude and longitude (degrees) and height (metres).
    """
    (sin_b, cos_b), (sin_l, cos_l) = ((np.sin(angle), np.cos(angle)) for angle in np.radians(place[:2]))
    east, up = np.array([-sin_l, cos_l, 0]), np.array([cos_b * cos_l, cos_b * sin_l, sin_b])
    eccentricity = _FLATTENING * (2 - _FLATTENING)  # squared
    radius = _EQUATOR / np.sqrt(1 - eccentricity * sin_b**2)
    origin = (radius + place[2]) * up - [0, 0, eccentricity * radius * sin_b]
    transform = np.eye(4)
    transform[:3] = np.stack([east, np.cross(up, east), up, origin], axis=1)
    return transform.T.ravel().tolist()
