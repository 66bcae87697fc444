"""The share of a training's time that the web page takes, with nobody, with somebody who looks, and who moves.

    python -m benchmarks.viewing.share SCENE [--iterations 2000] [--size 1280 720] [options of train.py]

"training": seconds without what was spent on frames, of train_log.json. "viewing": seconds spent on frames. "share":
viewing of both together. "slower": training and viewing together against the training without a page; this also has
what the server's thread and, on the same machine, the browser's stand-in take from a CPU. "CPU": seconds of all
threads of train.py's process, which other programs on the machine disturb less.
"""

import argparse
import contextlib
import json
import os
import re
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from benchmarks.harness.environment import describe, print_table
from utils.system_utils import UserError, compute_device, run_cli

HEADER = ["page", "training (s)", "viewing (s)", "share", "slower", "CPU (s)", "frames/s"]
CASES = {"none": None, "nobody looks": None, "somebody looks": 0.0, "somebody moves": 30.0}


def train(words: list[str], rate: float | None, size: list[int]) -> tuple[float, float, float, float]:
    """Seconds of training, viewing and CPU, and pictures a second, of a training that somebody may watch."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "train.py", "-m", folder, "--no_curve", "--test_iterations", "-1", *words]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
        seen, said = {"pictures": 0, "seconds": 1.0}, ""
        while rate is not None and (line := process.stderr.readline()):
            said += line
            if found := re.search(r"viewer: (http://\S+)", line):
                break
        reader = threading.Thread(target=process.stderr.read)
        reader.start()
        if rate is not None and found:
            more = ["--seconds", "36000", "--once", "0", "--rate", str(rate), "--size", *map(str, size)]
            browser = [sys.executable, "-m", "benchmarks.viewing.browser", found[1], *more]
            with contextlib.suppress(json.JSONDecodeError):
                seen = json.loads(subprocess.run(browser, capture_output=True, text=True).stdout)
        reader.join()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise UserError(f"train.py ended with status {process.returncode}:\n{said}")
        log = json.loads(Path(folder, "train_log.json").read_text())[-1]
    cpu = used.ru_utime + used.ru_stime
    return log["seconds"], log.get("viewing_seconds", 0.0), cpu, seen["pictures"] / seen["seconds"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", help="scene to train")
    parser.add_argument("--iterations", type=int, default=2000, help="of each training (default: 2000)")
    parser.add_argument("--size", type=int, nargs=2, default=[1280, 720], metavar=("W", "H"), help="of the window")
    args, options = parser.parse_known_args()
    rows, alone = [], 0.0
    for name, rate in CASES.items():
        words = ["-s", args.scene, "--iterations", str(args.iterations), *options]
        words += [] if name == "none" else ["--viewer", "0"]
        training, viewing, cpu, pictures = train(words, rate, args.size)
        alone = alone or training
        share, slower = viewing / (training + viewing), (training + viewing) / alone - 1
        row = [name, f"{training:.2f}", f"{viewing:.2f}", f"{share:.1%}", f"{slower:+.1%}"]
        row += [f"{cpu:.1f}", f"{pictures:.1f}"]
        rows.append(row)
    print(f"{describe(compute_device())}; {args.scene}, {args.iterations} iterations\n")
    print_table(HEADER, rows)


if __name__ == "__main__":
    run_cli(main)
