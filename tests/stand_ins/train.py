"""Stand-in for train.py: it writes the files of a training at once, with numbers that depend on the options.

With --advise it writes the scene's `advice.json`, or that nothing is asked for. --sparse_depth is what it adds to the
PSNR of seed 0, and twice that to seed 1. With --time_budget it ends three iterations later than with --iterations, and
three more for each seed above 0.
A file `broken` in the scene folder makes it fail, `full` makes it fail and leave a checkpoint, `slow` makes it wait for
a signal.
"""

import argparse
import json
import os
import signal
import sys
import time
from pathlib import Path

parser = argparse.ArgumentParser()
parser.add_argument("-s", type=Path)
parser.add_argument("-m", type=Path)
parser.add_argument("--iterations", type=int, default=30000)
parser.add_argument("--sh_degree", type=int, default=3)
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--time_budget", type=float, default=0)
parser.add_argument("--start_checkpoint")
parser.add_argument("--save_iterations", type=int, nargs="+", default=[7000, 30000])
parser.add_argument("--advise", action="store_true")
parser.add_argument("--appearance")
parser.add_argument("--sparse_depth", type=float, default=0)
args = parser.parse_known_args()[0]
end = args.iterations + (3 + 3 * args.seed if args.time_budget else 0)

with (args.s.parent / "calls.txt").open("a") as calls:
    calls.write(json.dumps(["train", *sys.argv[1:]]) + "\n")
args.m.mkdir(parents=True, exist_ok=True)
if (args.s / "broken").exists():
    sys.stderr.write("Training progress:  50%|#####     | 5/10\r\n")
    sys.exit("error: <b>the scene</b> is broken; fix it")


if args.advise:
    advice = args.s / "advice.json"
    nothing = json.dumps([{"text": "20 photos train", "options": ""}])
    (args.m / "advice.json").write_text(advice.read_text() if advice.exists() else nothing)
    sys.exit()

if (args.s / "full").exists():
    (args.m / "chkpnt9.pth").write_bytes(b"")
    sys.stderr.write("error: training ran out of memory\n")
    sys.exit(2)


def save(iteration: int) -> None:
    ply = args.m / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"
    ply.parent.mkdir(parents=True, exist_ok=True)
    ply.write_text(f"ply\nelement vertex {100 * iteration * (1 + args.sh_degree)}\nend_header\n")


def stop(signum, frame):
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: sys.exit("two signals: no checkpoint"))
    time.sleep(0.5)
    (args.m / ("chkpnt41.pth" if args.time_budget else "chkpnt5.pth")).write_bytes(b"")
    save(41 if args.time_budget else 5)
    sys.exit(128 + signum)


if (args.s / "slow").exists() and not args.start_checkpoint:
    (args.m / "pid").write_text(str(os.getpid()))
    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
    (args.s / "started").touch()
    time.sleep(600)
    sys.exit("no signal came")

best = 20.0 + args.sh_degree + 0.1 * args.seed + args.sparse_depth * (1 + args.seed)  # dB at the end
slowness = 1 + args.sh_degree  # seconds an iteration, times ten
scores = ",".join(f"{views}_{score}" for views in ("test", "train") for score in ("l1", "psnr", "ssim"))
rows = [f"iteration,seconds,wall_seconds,gaussians,peak_memory_mib,{scores}"]
for t in (end // 4, end // 2, end):
    progress = t / end
    cost = f"{t},{t * slowness / 10},{t},{100 * t * slowness},{300 + t}"
    rows.append(f"{cost},0.1,{best - 10 + 10 * progress},{0.7 + 0.2 * progress},0.1,30,0.95")
(args.m / "error_vs_time.csv").write_text("\n".join(rows) + "\n")
(args.m / "stand_in.json").write_text(json.dumps({"psnr": best, "appearance": args.appearance}))
(args.m / "cameras.json").write_text(json.dumps([{"img_name": f"photo_{i}.jpg"} for i in range(9)]))
log = []
for t in sorted({*args.save_iterations, *([end // 4] if "--keep_best" in sys.argv else []), end}):
    if t <= end:
        save(t)
        log.append({"iteration": t, "seconds": t * slowness / 10})
(args.m / "train_log.json").write_text(json.dumps(log))
