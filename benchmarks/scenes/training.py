"""Training runs, one per seed and number of ranks, scored on the held-out views as in published tables.

    python -m benchmarks.scenes.training SCENE OUT --seeds 0 1 2 --iterations 7000
    python -m benchmarks.scenes.training SCENE OUT --seeds 0 --ranks 1 2 --iterations 7000

Other options go to train.py unchanged. Training seconds do not include loading, tests and saving. Scores are those of
metrics.py, from 8-bit images. A seed given twice, or trained by several ranks, shows whether the bytes are the same.
"""

import argparse
import hashlib
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.harness.measuring import describe, print_table
from splatting.evaluation.comparison import FITTED
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


def all_scores(model: Path) -> dict[str, dict[str, float]]:
    """Return the scores of a model folder by method."""
    return json.loads((model / "results.json").read_text())


def scores_of(model: Path) -> dict[str, float]:
    """Return the scores of the first method of a model folder."""
    return next(iter(all_scores(model).values()))


def train(
    scene: Path,
    model: Path,
    seed: int,
    options: list[str],
    ranks: int = 1,
    shown: Sequence[str] = (),
    judged: Path | None = None,
    widths: Sequence[int] = (),
) -> dict:
    """Train, render and score one model; return seconds, scores, Gaussians, bytes and a hash of the PLY.

    shown: further options of render.py. judged: a scene whose test views are scored, where all views of `scene` train.
    widths: of test views, pixels, that are scored besides, against photos of that size: PSNR@WIDTH and so on.
    """
    words = ["-s", str(scene), "-m", str(model), "--seed", str(seed), "--test_iterations", "-1", "--no_curve"]
    words += [] if judged else ["--eval"]
    shown = [*shown, *(["-s", str(judged), "--eval", "--allow_other_scene"] if judged else [])]
    launcher = ["-m", "torch.distributed.run", "--standalone", f"--nproc_per_node={ranks}"] if ranks > 1 else []
    process = run(*launcher, "train.py", *words, *options)
    at_width = {}
    for width in widths:
        run("render.py", "-m", str(model), "--skip_train", *shown, "-r", str(width))
        run("metrics.py", "-m", str(model))
        at_width |= {f"{name}@{width}": value for name, value in scores_of(model).items()}
    run("render.py", "-m", str(model), "--skip_train", *shown)
    run("metrics.py", "-m", str(model))
    record = json.loads((model / "train_log.json").read_text())[-1]
    iteration = record["iteration"]
    ply = model / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"
    return {
        "seed": seed,
        "ranks": ranks,
        "seconds": seconds_of(model),
        "process": process,
        **scores_of(model),
        **at_width,
        "fitted": next((of["PSNR"] for name, of in all_scores(model).items() if name.endswith(FITTED)), None),
        "Gaussians": record["gaussians"],
        "bytes": ply.stat().st_size,
        "hash": hashlib.sha256(ply.read_bytes()).hexdigest()[:16],
    }


COLUMNS = {"seconds": ".1f", "process": ".1f", "PSNR": ".2f", "SSIM": ".4f", "Gaussians": ",.0f"}


def print_runs(runs: list[dict]) -> None:
    """Print a row for each run, means and deviations, and whether runs of one seed have the same bytes."""
    cells = [[f"{run[key]:{form}}" for key, form in COLUMNS.items()] for run in runs]
    rows = [[f"{r['seed']}", f"{r['ranks']}", *row, r["hash"]] for r, row in zip(runs, cells, strict=True)]
    for ranks in dict.fromkeys(run["ranks"] for run in runs):
        values = [[run[key] for run in runs if run["ranks"] == ranks] for key in COLUMNS]
        if len(values[0]) > 1:
            both = [(statistics.mean(column), statistics.stdev(column)) for column in values]
            means = [f"{mean:{form}} ({sd:{form}})" for (mean, sd), form in zip(both, COLUMNS.values(), strict=True)]
            rows.append(["mean (standard deviation)", f"{ranks}", *means, ""])
    print_table(["seed", "ranks", "training s", "process s", "PSNR dB", "SSIM", "Gaussians", "PLY sha256"], rows)
    for seed in sorted({run["seed"] for run in runs}):
        hashes = [run["hash"] for run in runs if run["seed"] == seed]
        if len(hashes) > 1:
            same = "the same" if len(set(hashes)) == 1 else "DIFFERENT"
            print(f"seed {seed}, {len(hashes)} runs: the PLYs are {same}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="a COLMAP or a Blender scene")
    parser.add_argument("out", type=Path, help="new folder for the models")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="one run each (default: 0 1 2)")
    parser.add_argument("--ranks", type=int, nargs="+", default=[1], help="numbers of processes (default: 1)")
    args, options = parser.parse_known_args()
    if args.out.exists():
        raise UserError(f"{args.out} exists; name a new folder")
    print(describe(compute_device()))
    print("train.py -s", args.scene.name, "--eval", *options, flush=True)
    runs = []
    for seed in args.seeds:
        for ranks in args.ranks:
            model = args.out.resolve() / f"run{len(runs)}_seed{seed}_ranks{ranks}"
            runs.append(train(args.scene.resolve(), model, seed, options, ranks))
            print(json.dumps(runs[-1]), flush=True)
    print_runs(runs)


if __name__ == "__main__":
    run_cli(main)
