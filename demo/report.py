"""Say how a trained, rendered and scored model did: a short table, and a contact sheet of some test views.

python -m demo.report MODEL [--views 4]
"""

from __future__ import annotations

import json
import re
import sys
from argparse import ArgumentParser
from pathlib import Path

import numpy as np
from PIL import Image

from arguments import read_cfg_args
from demo.contact_sheet import contact_sheet
from utils.image_files import UNREADABLE, open_render
from utils.system_utils import UserError, atomic_write, run_cli, searchForMaxIteration


def count_gaussians(model: Path, iteration: int) -> int:
    """Number of Gaussians of a saved iteration, from the header of its PLY."""
    ply = model / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"
    try:
        with ply.open("rb") as file:
            header = file.read(4096).split(b"end_header")[0]
    except OSError as error:
        raise UserError(f"cannot read {ply} ({error.strerror}); train the model again") from error
    found = re.search(rb"element vertex (\d+)", header)
    if not found:
        raise UserError(f"{ply} is not a PLY of Gaussians; train the model again")
    return int(found[1])


def load_scores(model: Path, method: str) -> tuple[dict[str, float | None], dict[str, dict[str, float | None]]]:
    """Mean scores, and scores by metric and view, that metrics.py has written for a method."""
    try:
        results = json.loads((model / "results.json").read_text())[method]
        per_view = json.loads((model / "per_view.json").read_text())[method]
        for numbers in ({key: results[key] for key in ("PSNR", "SSIM")}, per_view["PSNR"]):
            if not numbers or any(type(value) not in (int, float, type(None)) for value in numbers.values()):
                raise ValueError("no numbers")
    except (OSError, KeyError, ValueError, TypeError, AttributeError) as error:
        raise UserError(f"{model} has no scores of {method}; run render.py and metrics.py -m {model} first") from error
    return results, per_view


def training_seconds(model: Path, iteration: int) -> float | None:
    """Seconds of training until an iteration, without tests and saving; None when train.py has not logged them."""
    log = model / "train_log.json"
    if not log.is_file():
        return None
    try:
        seconds = {record["iteration"]: float(record["seconds"]) for record in json.loads(log.read_text())}
    except (OSError, KeyError, ValueError, TypeError) as error:
        print(f"{log} is damaged ({type(error).__name__}), so the training time is unknown", file=sys.stderr)
        return None
    return seconds.get(iteration)


def _picture(file: Path) -> Image.Image:
    try:
        with open_render(file) as image:
            return image.convert("RGB")
    except UNREADABLE as error:
        raise UserError(f"{file} is missing or damaged; run render.py and metrics.py again") from error


def _shown(value: float | None, digits: int, unit: str = "") -> str:
    return "-" if value is None else f"{value:.{digits}f}{unit}"


def main() -> None:
    parser = ArgumentParser(prog="python -m demo.report", description="Table and contact sheet of a trained model.")
    parser.add_argument("model", type=Path, help="model folder, rendered and scored")
    parser.add_argument("--views", type=int, default=4, help="test views on the contact sheet, evenly spread (4)")
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
        pictures = [_picture(model / "test" / method / side / name) for side in ("gt", "renders")]
        rows.append((f"test view {Path(name).stem}: {_shown(per_view['PSNR'][name], 2, ' dB')}", *pictures))
    count = count_gaussians(model, iteration)
    sheet = model / "contact_sheet.png"
    with atomic_write(sheet) as temporary:
        contact_sheet(rows).save(temporary)

    table = [
        ("scene", Path(str(read_cfg_args(model).get("source_path", "-"))).name),
        ("iterations", str(iteration)),
        ("training", _shown(training_seconds(model, iteration), 0, " s")),
        ("Gaussians", str(count)),
        ("test views", str(len(names))),
        ("PSNR", _shown(means["PSNR"], 2, " dB")),
        ("SSIM", _shown(means["SSIM"], 4)),
    ]
    widths = [max(len(cell) for cell in column) for column in table]
    for line in zip(*table, strict=True):
        print("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)))
    print(f"contact sheet  {sheet}")
    print(f"renders        {model / 'test' / method / 'renders'}")
    print(f"model          {model / 'point_cloud' / f'iteration_{iteration}' / 'point_cloud.ply'}")


if __name__ == "__main__":
    run_cli(main)
