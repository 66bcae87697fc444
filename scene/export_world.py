"""Write a model in the world's coordinates, with x, y, z in double and all other properties unchanged.

python -m scene.export_world MODEL OUT.ply [--iteration N]

Meant for scenes whose coordinates are much larger than their extent: they are trained in a local frame
(scene/readers/info.py). CloudCompare and plyfile read the doubles; programs that read x, y, z as float lose the
decimals again.
"""

import argparse
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement

from groundwork.files.json_files import OFFSET, read_model_json
from scene.gaussians.ply import read_vertices
from utils.system_utils import UserError, atomic_write, find_iteration, run_cli, saved_ply

_AXES = ("x", "y", "z")


def export_world(ply: Path, offset: np.ndarray, out: Path) -> None:
    """Write the Gaussians of a PLY with offset (3,) added to x, y, z, which become double."""
    vertices = read_vertices(ply)
    kinds = [(name, "<f8" if name in _AXES else vertices.dtype[name]) for name in vertices.dtype.names]
    moved = np.empty(len(vertices), dtype=kinds)
    for name in vertices.dtype.names:
        moved[name] = vertices[name]
    for name, distance in zip(_AXES, offset, strict=True):
        moved[name] += distance
    with atomic_write(out) as temporary:
        PlyData([PlyElement.describe(moved, "vertex")], byte_order="<").write(str(temporary))


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description="Write a model in the world's coordinates, x, y, z in double.")
    parser.add_argument("model", type=Path, help="folder that train.py wrote")
    parser.add_argument("out", type=Path, help="PLY to write")
    parser.add_argument("--iteration", type=int, default=-1, help="saved iteration (default: -1, the highest)")
    args = parser.parse_args()
    iteration = find_iteration(args.model, args.iteration)
    ply = saved_ply(args.model, iteration)
    if args.out.resolve() == ply.resolve():
        raise UserError(f"{args.out} is the model itself; name another file")
    offset = np.array(read_model_json(args.model).get(OFFSET, [0, 0, 0]), dtype=np.float64)
    export_world(ply, offset, args.out)
    print(f"{args.out}: iteration {iteration}, moved by {tuple(offset.tolist())}")


if __name__ == "__main__":
    run_cli(main)
