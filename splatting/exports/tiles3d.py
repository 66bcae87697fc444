"""3D Tiles 1.1 (OGC 22-025r4): tileset.json beside a folder of GLB with KHR_gaussian_splatting, for large models.

A viewer draws the tiles of an octree that are as fine as the distance asks for, and loads no others. A GLB has y up,
and tiles have z up, so a viewer turns x y z of a GLB to x -z y. Boxes are in these axes. Nothing places the model on a
globe.
"""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from scene.splats.splats import Splats
from splatting.exports.beside import PLACE, with_folder
from splatting.exports.levels import Tile, Views, octree, table
from splatting.exports.scene_formats import EXTENSION, write_glb

_ANNOUNCED = "3DTILES_content_gltf"  # says ahead of loading which extensions GLB files use


def write_tileset(path: str | os.PathLike, splats: Splats, around: Views) -> str:
    """Write a tileset, whole or not at all, print what each level loses, and return a part of a sentence about it.

    The files of an earlier tileset of this name go once the new one is there.
    """
    root, path, sizes = octree(splats), Path(path), {}
    with with_folder(path, "tiles-") as folder:
        for tile in root.all():
            if len(tile.splats):
                write_glb(folder / f"{tile.name}.glb", tile.splats)
                sizes[tile.name] = (folder / f"{tile.name}.glb").stat().st_size
        (folder / path.name).write_text(json.dumps(document(root, PLACE), allow_nan=False), encoding="utf-8")
    levels = [root.level(depth) for depth in range(root.levels)]
    print(table(root, [sum(sizes.get(tile.name, 0) for tile in level) for level in levels], around))
    return f"{root.levels} levels, {len(sizes)} tiles with {sum(sizes.values()) / 1e6:.2f} MB in a folder beside it"


def document(root: Tile, folder: str) -> dict[str, Any]:
    """The content of tileset.json."""
    width = float(np.linalg.norm(root.high - root.low))
    return {
        "asset": {"version": "1.1", "extras": {"generator": "export.py", "folder": folder}},
        "extensionsUsed": [_ANNOUNCED],
        "extensions": {_ANNOUNCED: {"extensionsUsed": [EXTENSION]}},
        "geometricError": max(width, 2 * root.error),  # of a viewer that draws nothing
        "root": {"refine": "REPLACE", **_entry(root, folder)},
    }


def _entry(tile: Tile, folder: str) -> dict[str, Any]:
    entry = {"boundingVolume": {"box": box(tile.low, tile.high)}, "geometricError": tile.error}
    if len(tile.splats):
        entry["content"] = {"uri": f"{folder}/{tile.name}.glb"}
    if tile.children:
        entry["children"] = [_entry(child, folder) for child in tile.children]
    return entry


def box(low: np.ndarray, high: np.ndarray) -> list[float]:
    """A boundingVolume's middle and half axes, 12 numbers in the axes of tiles, of corners (3,) in those of COLMAP.

    The GLB's node takes x y z to x -y -z, and the viewer that to x z -y.
    """
    middle, half = ((low + high) / 2)[[0, 2, 1]] * [1, 1, -1], ((high - low) / 2)[[0, 2, 1]]
    return [*middle.tolist(), *np.diag(half).ravel().tolist()]
