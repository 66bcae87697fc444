"""Report on a trained, rendered and scored model: a short table, and a contact sheet of some test views.

python -m applications.demo.report MODEL [--views 4]
"""

from __future__ import annotations

import os
import sys
from argparse import ArgumentParser
from pathlib import Path

import numpy as np

from arguments import read_cfg_args
from splatting.records.model_folder import count_gaussians, load_scores, training_seconds
from splatting.records.renders import contact_sheet, image_of
from utils.system_utils import UserError, atomic_write, run_cli, searchForMaxIteration


def _format_value(value: float | None, digits: int, unit: str = "") -> str:
    return "-" if value is None else f"{value:.{digits}f}{unit}"


def main() -> None:
    """Print the table of a model, and write its contact sheet."""
    parser = ArgumentParser(
        prog="python -m applications.demo.report", description="Table and contact sheet of a trained model."
    )
    parser.add_argument("model", type=Path, help="model folder, already rendered and scored")
    parser.add_argument("--views", type=int, default=4, help="number of test views on the contact sheet (4)")
    args = parser.parse_args()
    if args.views < 1:
        raise UserError(f"--views must be at least 1, got {args.views}")
    model = args.model
    iteration = searchForMaxIteration(model / "point_cloud")
    method = f"ours_{iteration}"
    means, per_view = load_scores(model, method)

    names = sorted(per_view["PSNR"])
    picked = [names[k] for k in np.linspace(0, len(names) - 1, min(args.views, len(names))).round().astype(int)]
    rows = []
    for name in picked:
        images = [image_of(model / "test" / method / side / name) for side in ("gt", "renders")]
        rows.append((f"test view {Path(name).stem}: {_format_value(per_view['PSNR'][name], 2, ' dB')}", *images))
    count = count_gaussians(model, iteration)
    sheet = model / "contact_sheet.png"
    with atomic_write(sheet) as temporary:
        contact_sheet(rows).save(temporary)

    table = [
        ("scene", Path(str(read_cfg_args(model).get("source_path", "-"))).name),
        ("iterations", str(iteration)),
        ("training", _format_value(training_seconds(model, iteration), 0, " s")),
        ("Gaussians", str(count)),
        ("test views", str(len(names))),
        ("PSNR", _format_value(means["PSNR"], 2, " dB")),
        ("SSIM", _format_value(means["SSIM"], 4)),
    ]
    widths = [max(len(cell) for cell in column) for column in table]
    for line in zip(*table, strict=True):
        print("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)))
    print(f"renders        {model / 'test' / method / 'renders'}")
    print(f"model          {model / 'point_cloud' / f'iteration_{iteration}' / 'point_cloud.ply'}")
    print(f"contact sheet  {sheet}")
    print(f"to see it      {min(sys.executable, os.path.relpath(sys.executable), key=len)} view.py -m {model}")


if __name__ == "__main__":
    run_cli(main)
