"""Put real faults of other programs into a private copy of this project, and print which test finds each.

python -m tests.mutations [NAME ...] [--psnr SCENE ...] [--folder FOLDER]
"""

import argparse
import json
import re
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from mutations.faults import FAULTS, Fault, check  # noqa: E402
from mutations.private_copy import EMULATED, ROOT, PrivateCopy  # noqa: E402

# Fast tests of what the faults are in, cheapest and most general first: the first one that fails is reported.
FILES = (
    *("test_rasterizer_rules", "test_rasterizer_oracle", "test_rasterizer_gradients", "test_rasterizer_tiles"),
    *("test_absolute_gradients", "test_rasterizer_adam", "test_borders"),
)
TRAINING = ("--eval", "-r", "4", "--iterations", "500", "--test_iterations", "500", "--densify_from_iter", "100")
SEEDS = range(3)
LONGEST = 600  # seconds of a test run


def main() -> int:
    """Return 1 if no test finds some fault, or if a test fails without one."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutations", description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="parts of faults' names (default: all)")
    parser.add_argument("--psnr", nargs="+", type=Path, default=[], metavar="SCENE",
        help="train on these scenes with each fault, and print the PSNR that it costs, instead of tests")  # fmt: skip
    parser.add_argument("--folder", type=Path, default=ROOT / "build" / "mutations", help="of the private copy")
    args = parser.parse_args()
    try:
        check(ROOT)
    except ValueError as error:
        parser.error(str(error))
    chosen = [fault for fault in FAULTS if not args.names or any(name in fault.name for name in args.names)]
    copy = PrivateCopy(args.folder)
    return _costs(copy, chosen, [scene.resolve() for scene in args.psnr]) if args.psnr else _found(copy, chosen)


def _found(copy: PrivateCopy, faults: Sequence[Fault]) -> int:
    """Print the test that finds each fault."""
    for on_gpu in sorted({fault.on_gpu for fault in faults}):
        if failed := first_failure(copy, on_gpu):
            print(f"error: without a fault, {failed}")
            return 1
    print("| fault | in | first test that fails | s |\n| --- | --- | --- | --- |", flush=True)
    missed = 0
    for fault in faults:
        with copy.altered(fault):
            begin = time.monotonic()
            failed = first_failure(copy, fault.on_gpu)
        missed += not failed
        seconds = time.monotonic() - begin
        print(f"| {fault.name} | {fault.origin} | {failed or 'NONE'} | {seconds:.0f} |", flush=True)
    return 1 if missed else 0


def first_failure(copy: PrivateCopy, on_gpu: bool) -> str:
    """The first test that fails, crashes or hangs; empty if all pass. on_gpu: of the emulated CUDA kernels."""
    command = [str(copy.tree / EMULATED)]
    if not on_gpu:
        files = [f"tests/{name}.py" for name in FILES]
        command = [sys.executable, "-m", "pytest", "-x", "-v", "-p", "no:cacheprovider", *files]
        command += ["-m", "not slow and not gpu"]
    try:
        done = subprocess.run(
            command, cwd=copy.tree, env=copy.environment(), capture_output=True, text=True, timeout=LONGEST
        )
    except subprocess.TimeoutExpired:
        return f"no end after {LONGEST} s"
    if done.returncode == 0:
        return ""
    if on_gpu:
        return "test_cuda_emulated.cpp"
    if failed := re.search(r"^(?:FAILED|ERROR) tests/(\S+)", done.stdout, re.MULTILINE):
        return failed[1].partition("[")[0]
    last = re.findall(r"^tests/(\S+)", done.stdout, re.MULTILINE)
    return f"{last[-1].partition('[')[0]} (crash)" if last else f"pytest: {done.stderr.strip()[-200:]}"


def _costs(copy: PrivateCopy, faults: Sequence[Fault], scenes: Sequence[Path]) -> int:
    """Print what each fault costs: the mean of the seeds' differences, and their range."""
    print(f"`train.py {' '.join(TRAINING)}`, seeds {', '.join(map(str, SEEDS))}")
    print("| fault |", *(f"{scene.name}: without, with the fault, cost (range), dB |" for scene in scenes))
    print("| --- |" + " --- |" * len(scenes), flush=True)
    without = [_psnr(copy, scene) for scene in scenes]
    for fault in faults:
        row = ["only on a GPU"] * len(scenes)
        if not fault.on_gpu:
            with copy.altered(fault):
                row = [_difference(plain, _psnr(copy, scene)) for plain, scene in zip(without, scenes, strict=True)]
        print("|", " | ".join([fault.name, *row]), "|", flush=True)
    return 0


def _difference(without: Sequence[float], with_fault: Sequence[float]) -> str:
    lost = [a - b for a, b in zip(without, with_fault, strict=True)]
    cost = f"{statistics.mean(lost):.2f} ({min(lost):.2f} to {max(lost):.2f})"
    return f"{statistics.mean(without):.2f}, {statistics.mean(with_fault):.2f}, {cost}"


def _psnr(copy: PrivateCopy, scene: Path) -> list[float]:
    """Test PSNR of a short training with each seed; NaN where it fails."""
    found, out = [], copy.tree.parent / "model"
    for seed in SEEDS:
        shutil.rmtree(out, ignore_errors=True)
        command = [sys.executable, "train.py", "-s", str(scene), "-m", str(out), *TRAINING, "--seed", str(seed)]
        done = subprocess.run(command, cwd=copy.tree, env=copy.environment(), capture_output=True)
        log = out / "train_log.json"
        found.append(json.loads(log.read_text())[-1]["test_psnr"] if done.returncode == 0 else float("nan"))
    return found


if __name__ == "__main__":
    sys.exit(main())
