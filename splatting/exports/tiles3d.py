"""3D Tiles 1.1 (OGC 22-025r4): tileset.json beside a folder of GLB with KHR_gaussian_splatting, for large models.

A viewer draws the tiles of an octree that are as fine as the distance asks for, and loads no others. A GLB has y up,
and tiles have z up, so a viewer turns x y z of a GLB to x -z y. Boxes are in these axes. Nothing places the model on a
globe.
"""

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from scene.splats.splats import Splats
from splatting.exports.levels import Tile, losses, octree
from splatting.exports.scene_formats import EXTENSION, write_glb
from splatting.files.listing import markdown_table
from utils.system_utils import atomic_write, mkdir_p

_ANNOUNCED = "3DTILES_content_gltf"  # says ahead of loading which extensions GLB files use
_FOLDER = "tiles-"


class Views(Protocol):
    """What the levels are compared on: as `splatting.exports.formats.Around`."""

    cameras: Any
    background: Any
    pipe: Any


def write_tileset(path: str | os.PathLike, splats: Splats, around: Views) -> str:
    """Write a tileset, whole or not at all, print what each level loses, and return a part of a sentence about it.

    The files of an earlier tileset of this name go once the new one is there.
    """
    root, path = octree(splats), Path(path)
    sizes, earlier = {}, _folder_of(path)
    with contextlib.ExitStack() as stack:
        temporary = stack.enter_context(atomic_write(path))
        folder = stack.enter_context(_new_folder(path.parent))
        for tile in root.all():
            if len(tile.splats):
                write_glb(folder / f"{tile.name}.glb", tile.splats)
                sizes[tile.name] = (folder / f"{tile.name}.glb").stat().st_size
        final = path.parent / (_FOLDER + _digest(folder))
        temporary.write_text(json.dumps(document(root, final.name), allow_nan=False), encoding="utf-8")
        if not final.exists():  # else these are the same files
            os.replace(folder, final)
    if earlier and earlier != final:
        shutil.rmtree(earlier, ignore_errors=True)
    print(table(root, sizes, around))
    return f"{root.levels} levels, {len(sizes)} tiles with {sum(sizes.values()) / 1e6:.2f} MB in {final.name}"


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


def table(root: Tile, sizes: Mapping[str, int], around: Views) -> str:
    """What each level has and loses, coarsest first, as Markdown."""
    found = losses(root, around.cameras, around.background, around.pipe)
    best, rows = found[-1]["photos"], []
    for depth, loss in enumerate(found):
        tiles = root.level(depth)
        counts = len(tiles), sum(len(tile.splats) for tile in tiles), sum(sizes.get(tile.name, 0) for tile in tiles)
        row = [str(depth), *(f"{count:,}" for count in counts), f"{max(tile.error for tile in tiles):.3g}"]
        row.append("equal" if loss["psnr"] is None else f"{loss['psnr']:.2f}")
        if best is not None:
            row += [f"{loss['photos']:.2f}", f"{loss['photos'] - best:+.2f}"]
        rows.append(row)
    header = ["level", "tiles", "Gaussians", "bytes", "error (units)", "dB to the model"]
    return markdown_table(header + ["dB to the photos", "change"] * (best is not None), rows).rstrip("\n")


@contextlib.contextmanager
def _new_folder(parent: Path) -> Iterator[Path]:
    """A hidden folder, which is deleted at the end unless it has another name by then."""
    folder = parent / f".tiles.{os.getpid()}.tmp"
    mkdir_p(folder)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _digest(folder: Path) -> str:
    """A name for the files of a folder, by their names and bytes."""
    found = hashlib.sha256()
    for path in sorted(folder.iterdir()):
        found.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return found.hexdigest()[:12]


def _folder_of(path: Path) -> Path | None:
    """The folder of an earlier tileset that export.py wrote; None without one."""
    try:
        name = json.loads(path.read_text(encoding="utf-8"))["asset"]["extras"]["folder"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    known = isinstance(name, str) and name.startswith(_FOLDER) and Path(name).name == name
    return path.parent / name if known else None
