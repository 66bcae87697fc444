"""Fit a scene's depth maps to its COLMAP points.

Each map of inverse depth gets a scale and an offset, in depth_params.json beside the model. Metric maps get one scale
for all, in metric.json beside them.

python utils/make_depth_scale.py --base_dir SCENE --depths_dir SCENE/depths
"""

import argparse
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path

if not __package__:  # run as a file: Python searches this folder, and the imports lie one folder up
    sys.path[0] = str(Path(__file__).resolve().parents[1])

from scene.readers.depth_maps import Metric  # noqa: E402
from scene.readers.depth_scale import make_depth_params, make_metric_scale  # noqa: E402
from utils.system_utils import run_cli  # noqa: E402


def main(argv: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description="Fit a scene's depth maps to its COLMAP points, for train.py -d.")
    parser.add_argument("--base_dir", required=True, metavar="SCENE", help="scene folder (COLMAP)")
    parser.add_argument("--depths_dir", required=True, metavar="FOLDER",
        help="folder of depth maps, named like the photos: inverse depth as grey PNG of 8 or 16 bits, or metres as "
        ".npy, .pfm, or 16-bit PNG with a metric.json")  # fmt: skip
    parser.add_argument("--model_type", choices=("bin", "txt"), default="bin",
        help="kind of the COLMAP model's files (default: bin)")  # fmt: skip
    args = parser.parse_args(argv)
    scene, depths = Path(args.base_dir), Path(args.depths_dir)
    if metric := Metric.from_folder(depths):
        scale, spread, maps, photos = make_metric_scale(scene, depths, metric, args.model_type)
        print(
            f"{maps} of {photos} photos have a metric map: {scale:.4g} units of the scene for each metre, and half of "
            f"the points within {spread:.1%} of that"
        )
        return
    table, photos = make_depth_params(scene, depths, args.model_type)
    scales = [entry["scale"] for entry in table.values() if entry["scale"] > 0]
    median = f", median scale {statistics.median(scales):.4g}" if scales else ""
    print(
        f"{len(table)} of {photos} photos have a depth map{median}; {len(table) - len(scales)} of them see too few "
        "points for a fit and get no depth loss"
    )


if __name__ == "__main__":
    run_cli(main)
