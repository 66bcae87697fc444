"""Stand-in for render.py: it writes two grey test views, with a brighter stripe in the renders."""

import argparse
import json
import sys
from pathlib import Path

from PIL import Image

parser = argparse.ArgumentParser()
parser.add_argument("-s", type=Path)
parser.add_argument("-m", type=Path)
parser.add_argument("--iteration")
parser.add_argument("--appearance")
args = parser.parse_known_args()[0]

if args.s:
    with (args.s.parent / "calls.txt").open("a") as calls:
        calls.write(json.dumps(["render", *sys.argv[1:]]) + "\n")
folder = args.m / "test" / f"ours_{args.iteration}"
for side in ("gt", "renders"):
    (folder / side).mkdir(parents=True, exist_ok=True)
    for index in range(2):
        image = Image.new("RGB", (120, 80), (90, 90, 90))
        if side == "renders":
            image.paste((110, 90, 90), (0, 0, 120, 20))
        image.save(folder / side / f"{index:05d}.png")
if args.appearance or json.loads((args.m / "stand_in.json").read_text())["appearance"]:
    folder.with_name(f"{folder.name}_fitted_appearance").mkdir(exist_ok=True)
(folder / "render_times.json").write_text(json.dumps({"median_ms": 4.0, "fps": 250.0}))
