"""Training of a scene by one process and by several ranks of one host: seconds, scores, and whether bytes are equal.

    python -m benchmarks.parallel.training SCENE --ranks 2 --iterations 7000

Other options go to train.py unchanged. Seconds are those of training, and those of the whole command.
"""

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.harness.environment import describe, print_table
from utils.system_utils import UserError, compute_device, run_cli

ROOT = Path(__file__).resolve().parents[2]
_HEADER = ["ranks", "shared", "seconds", "of the command", "Gaussians", "PSNR of test views", "PLY", "as one process"]


def train(scene: Path, out: Path, count: int, options: list[str], limit: float) -> dict | None:
    """Train by so many processes: its last record, seconds of the command, digest of the PLY. None if it fails."""
    start = [] if count == 1 else ["-m", "torch.distributed.run", "--standalone", f"--nproc_per_node={count}"]
    line = [sys.executable, *start, "train.py", "-s", str(scene), "-m", str(out), "--eval", "--disable_viewer"]
    began = time.perf_counter()
    try:
        status = subprocess.run([*line, *options], cwd=ROOT, stdout=sys.stderr, timeout=limit).returncode
    except subprocess.TimeoutExpired:
        status = f"none in {limit:.0f} seconds"
    if status:
        print(f"{count} processes: no model (status {status})", file=sys.stderr)
        return None
    record = json.loads((out / "train_log.json").read_text())[-1]
    ply = out / "point_cloud" / f"iteration_{record['iteration']}" / "point_cloud.ply"
    digest = hashlib.sha256(ply.read_bytes()).hexdigest()[:16]
    return record | {"process": time.perf_counter() - began, "digest": digest}


def cells(count: int, parallel: str, found: dict | None, alone: dict | None) -> list[str]:
    """A row of the table."""
    if found is None:
        return [f"{count}", parallel, "failed", *[""] * 5]
    equal = "" if alone is None else "equal" if found["digest"] == alone["digest"] else "other bytes"
    psnr = f"{found['test_psnr']:.3f}" if "test_psnr" in found else ""
    shown = f"{found['seconds']:.2f}", f"{found['process']:.1f}", f"{found['gaussians']:,}"
    return [f"{count}", parallel, *shown, psnr, found["digest"], equal]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("scene", type=Path, help="a COLMAP or a Blender scene")
    add("--ranks", type=int, nargs="+", default=[2], help="besides one process (default: 2)")
    add("--parallel", nargs="+", choices=["tiles", "views"], default=["tiles"], help="default: tiles")
    add("--iterations", type=int, default=7000, help="default: 7000")
    add("--limit", type=float, default=200.0, help="seconds of a training (default: 200)")
    args, options = parser.parse_known_args()
    if min(args.ranks) < 2:
        raise UserError("--ranks takes numbers from 2 on; one process is always trained")
    print(describe(compute_device()), flush=True)
    rows, alone = [], None
    with tempfile.TemporaryDirectory() as folder:
        for count, parallel in [(1, ""), *((n, shared) for n in args.ranks for shared in args.parallel)]:
            words = ["--iterations", str(args.iterations), *(["--parallel", parallel] if parallel else []), *options]
            found = train(args.scene, Path(folder) / f"{count}{parallel}", count, words, args.limit)
            alone = found if count == 1 else alone
            rows.append(cells(count, parallel, found, alone))
            print(*rows[-1], flush=True)
    print_table(_HEADER, rows)


if __name__ == "__main__":
    run_cli(main)
