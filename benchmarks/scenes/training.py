"""Training runs, one per seed, scored on the held-out views as in published tables.

    python -m benchmarks.scenes.training SCENE OUT --seeds 0 1 2 --iterations 7000

Other options go to train.py unchanged. Training seconds do not include loading, tests and saving. Scores are those of
metrics.py, from 8-bit images. A seed given twice shows whether the same command gives the same bytes.
"""

import argparse
import hashlib
import json
import statistics
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.harness.environment import describe, print_table
from utils.system_utils import UserError, compute_device, run_cli

ROOT = Path(__file__).resolve().parents[2]


def run(script: str, *options: str, folder: Path = ROOT, environment: dict[str, str] | None = None) -> float:
    """Run a script of the repository, or of another checkout; return its wall seconds.

    environment: None: that of this process. UserError with the end of its output if it fails.
    """
    start = time.perf_counter()
    words = [sys.executable, script, *options]
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True)
    if done.returncode:
        said = (done.stdout + done.stderr)[-4000:]
        raise UserError(f"{script} {' '.join(options)} ended with status {done.returncode}:\n{said}")
    return time.perf_counter() - start


def seconds_of(model: Path) -> float:
    """Return the training seconds of a model folder."""
    return json.loads((model / "train_log.json").read_text())[-1]["seconds"]


def train(scene: Path, model: Path, seed: int, options: list[str]) -> dict:
    """Train, render and score one model; return seconds, PSNR (dB), SSIM, Gaussians, bytes and a hash of the PLY."""
    arguments = ["-s", str(scene), "-m", str(model), "--eval", "--seed", str(seed)]
    process = run("train.py", *arguments, "--test_iterations", "-1", "--no_curve", *options)
    run("render.py", "-m", str(model), "--skip_train")
    run("metrics.py", "-m", str(model))
    record = json.loads((model / "train_log.json").read_text())[-1]
    iteration = record["iteration"]
    scores = json.loads((model / "results.json").read_text())[f"ours_{iteration}"]
    ply = model / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"
    return {
        "seed": seed,
        "seconds": seconds_of(model),
        "process": process,
        "PSNR": scores["PSNR"],
        "SSIM": scores["SSIM"],
        "Gaussians": record["gaussians"],
        "bytes": ply.stat().st_size,
        "hash": hashlib.sha256(ply.read_bytes()).hexdigest()[:16],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="a COLMAP or a Blender scene")
    parser.add_argument("out", type=Path, help="new folder for the models")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="one run each (default: 0 1 2)")
    args, options = parser.parse_known_args()
    if args.out.exists():
        raise UserError(f"{args.out} exists; name a new folder")
    print(describe(compute_device()))
    print("train.py -s", args.scene.name, "--eval", *options, flush=True)
    runs = []
    for number, seed in enumerate(args.seeds):
        runs.append(train(args.scene.resolve(), args.out.resolve() / f"run{number}_seed{seed}", seed, options))
        print(json.dumps(runs[-1]), flush=True)
    rows = [
        [str(r["seed"]), f"{r['seconds']:.1f}", f"{r['process']:.1f}", f"{r['PSNR']:.2f}", f"{r['SSIM']:.4f}"]
        + [f"{r['Gaussians'] / 1e3:.1f} k", r["hash"]]
        for r in runs
    ]
    if len(runs) > 1:
        rows.append(["mean (standard deviation)"])
        columns = [("seconds", 1, 1), ("process", 1, 1), ("PSNR", 1, 2), ("SSIM", 1, 4), ("Gaussians", 1e-3, 1)]
        for key, scale, digits in columns:
            values = [scale * r[key] for r in runs]
            rows[-1].append(f"{statistics.mean(values):.{digits}f} ({statistics.stdev(values):.{digits}f})")
        rows[-1].append("")
    print_table(["seed", "training s", "process s", "PSNR dB", "SSIM", "Gaussians", "PLY sha256"], rows)
    for seed in sorted({r["seed"] for r in runs}):
        hashes = [r["hash"] for r in runs if r["seed"] == seed]
        if len(hashes) > 1:
            same = "the same" if len(set(hashes)) == 1 else "DIFFERENT"
            print(f"seed {seed}, {len(hashes)} runs: the PLYs are {same}")


if __name__ == "__main__":
    run_cli(main)
