"""Fit a scene's depth maps to its COLMAP points and write depth_params.json beside the model, for train.py --depths.

python utils/make_depth_scale.py --base_dir SCENE --depths_dir SCENE/depths
"""

import argparse
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path

if not __package__:  # run as a file: Python searches this folder, and the imports lie one folder up
    sys.path[0] = str(Path(__file__).resolve().parents[1])

from scene.readers.depth_scale import make_depth_params  # noqa: E402
from utils.system_utils import run_cli  # noqa: E402


def main(argv: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description="Fit a scene's depth maps to its COLMAP points: depth_params.json.")
    parser.add_argument("--base_dir", required=True, metavar="SCENE", help="scene folder (COLMAP)")
    parser.add_argument("--depths_dir", required=True, metavar="FOLDER",
        help="folder of inverse depth maps, grey PNG of 8 or 16 bits, named like the photos")  # fmt: skip
    parser.add_argument("--model_type", choices=("bin", "txt"), default="bin",
        help="kind of the COLMAP model's files (default: bin)")  # fmt: skip
    args = parser.parse_args(argv)
    table, photos = make_depth_params(Path(args.base_dir), Path(args.depths_dir), args.model_type)
    scales = [entry["scale"] for entry in table.values() if entry["scale"] > 0]
    median = f", median scale {statistics.median(scales):.4g}" if scales else ""
    print(
        f"{len(table)} of {photos} photos have a depth map{median}; {len(table) - len(scales)} of them see too few "
        "points for a fit and get no depth loss"
    )


if __name__ == "__main__":
    run_cli(main)
