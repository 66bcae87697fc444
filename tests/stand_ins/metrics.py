"""Stand-in for metrics.py: it gives the PSNR that the stand-in for train.py left, and less for the second view."""

import argparse
import json
import os
import sys
from pathlib import Path

parser = argparse.ArgumentParser()
parser.add_argument("-m", type=Path)
parser.add_argument("--weights")
parser.add_argument("--error_maps", action="store_true")
args = parser.parse_args()

with (args.m / "scored.txt").open("a") as calls:
    calls.write(json.dumps([os.environ.get("GS_DOWNLOAD"), *sys.argv[1:]]) + "\n")
psnr = json.loads((args.m / "stand_in.json").read_text())["psnr"]
means, per_view = {}, {}
for folder in (args.m / "test").iterdir():
    means[folder.name] = {"SSIM": 0.9, "PSNR": psnr, "LPIPS": None} | ({"DISTS": 0.125} if args.weights else {})
    per_view[folder.name] = {"PSNR": {"00000.png": psnr + 1, "00001.png": psnr - 1}}
for name in ("00000.jpg", "00001.jpg") if args.error_maps else ():
    (folder / "errors").mkdir(exist_ok=True)
    (folder / "errors" / name).touch()
(args.m / "results.json").write_text(json.dumps(means))
(args.m / "per_view.json").write_text(json.dumps(per_view))
(args.m / "metrics_info.json").write_text(json.dumps({"conventions": {"PSNR": "dB"}}))
