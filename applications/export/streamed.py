"""Streamed SOG of PlayCanvas: lod-meta.json beside a folder of SOG, for large models. splat-transform writes it.

It cuts each level into chunks, and a viewer loads those that it needs. The levels are those of tileset.json.
"""

import json
import os
from pathlib import Path

from applications.export.levels import Views, build_octree, join_splats, make_table
from applications.export.side_files import PLACE, write_with_folder
from applications.export.sog import PROGRAM, find_splat_transform, run_program, warn_if_slow
from scene.splats.ply import write_plain_ply
from scene.splats.splats import Splats
from utils.system_utils import UserError, temporary_folder


def write_lod_meta(path: str | os.PathLike, splats: Splats, around: Views) -> str:
    """Write a streamed SOG, whole or not at all, print what each level loses, and return a part of a sentence about it.

    The dB are of the levels' Gaussians, without the rounding of SOG. UserError as from `write_sog`.
    """
    program, path = find_splat_transform(path), Path(path)
    if not len(splats):
        raise UserError(f"{path} would have no splats, which {PROGRAM} does not write; choose another format")
    warn_if_slow(len(splats), splats.sh_degree)
    root = build_octree(splats)
    with temporary_folder() as models, write_with_folder(path, "sog-") as folder:
        inputs = []
        for level in range(root.levels):  # 0 is the finest there
            model = models / f"{level}.ply"
            write_plain_ply(model, join_splats([tile.splats for tile in root.level(root.levels - 1 - level)]))
            inputs += [str(model), "-l", str(level)]  # whose long name differs between its versions
        written = folder / "lod-meta.json"
        run_program(program, inputs, written, path)
        content = json.loads(written.read_text(encoding="utf-8"))
        written.unlink()
        parts = content["filenames"]
        sizes = [_count_bytes(folder, [name for name in parts if name.startswith(f"{k}_")]) for k in range(root.levels)]
        content["filenames"] = [f"{PLACE}/{name}" for name in parts]
        content["asset"]["extras"] = {"folder": PLACE}
        (folder / path.name).write_text(json.dumps(content), encoding="utf-8")
    print(make_table(root, sizes[::-1], around))
    return f"{root.levels} levels, {len(parts)} chunks with {sum(sizes) / 1e6:.2f} MB in a folder beside it"


def _count_bytes(folder: Path, parts: list[str]) -> int:
    """Bytes of the files of chunks, which are named by their meta.json."""
    return sum(file.stat().st_size for part in parts for file in (folder / part).parent.iterdir())
