"""Kill trainings at random and at aimed moments, resume them, and compare the end with a training that was let be.

python -m tests.kills N [SEED]

Kills are SIGKILL: after a random time, and before, in or after the n-th write of a file. A trial kills one to ten
times, and repeats the same command with --resume until the training is finished. Checkpoints for --resume are written
in every 5th iteration; half of the trials plan others besides. At its end the PLYs, the tensors of the checkpoints and
the names of all files must be those of the training that was let be, with no temporary file or lock left over.
Trainings are forked from this process, which has everything imported.
"""

import argparse
import hashlib
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import groundwork.host.openmp  # noqa: F401  isort: skip  (before torch)
import matplotlib.pyplot  # noqa: F401  (here: otherwise every child would start a process that imports it)
import numpy as np
import torch

import train
import utils.system_utils
from scene.readers.point_cloud import write_point_cloud
from splatting import resume

sys.path.insert(0, str(Path(__file__).parent))
from synthetic import make_blender_scene  # noqa: E402
from trainings import leaves  # noqa: E402

OPTIONS = (
    *("--iterations", "60", "--eval", "--quiet", "--test_iterations", "30", "60", "--save_iterations", "20", "40"),
    *("--densify_from_iter", "5", "--densification_interval", "10", "--opacity_reset_interval", "25"),
    *("--train_test_exp", "--resume"),
)
PLANNED = "--checkpoint_iterations", "10", "20", "30", "40", "50", "60"
MOST = 10  # kills of a trial
MOMENTS = ("before", "in", "after")


def main() -> int:
    """Return 1 if a trial ended differently."""
    parser = argparse.ArgumentParser(prog="python -m tests.kills", description="Kill trainings, resume them, compare.")
    parser.add_argument("kills", type=int, help="stop after this number of kills")
    parser.add_argument("seed", type=int, nargs="?", default=0)
    args = parser.parse_args()
    rng, begin = random.Random(args.seed), time.monotonic()
    counts, trials, wrong = Counter(), 0, 0
    with tempfile.TemporaryDirectory(prefix="kills") as folder:
        scene, out = Path(folder, "scene"), Path(folder, "out")
        make_blender_scene(scene)
        points = np.random.default_rng(0).normal(size=(300, 3))  # a scene without points would start with 100,000
        write_point_cloud(scene / "points3d.ply", points, np.full((300, 3), 127, np.uint8))
        undisturbed = cache(lambda words: _undisturbed(scene, Path(folder, "undisturbed"), words))
        while counts.total() < args.kills:
            shutil.rmtree(out, ignore_errors=True)
            words = ((), PLANNED)[trials % 2]
            expected, seconds, writes = undisturbed(words)
            done = _trial(rng, scene, out, words, seconds, writes)
            counts.update(name.split()[0] for name in done)
            trials += 1
            if differences := expected ^ _state(out):
                wrong += 1
                print(f"WRONG after {', '.join(done)}: {sorted(differences)}", flush=True)
    by_moment = ", ".join(f"{count} {name}" for name, count in counts.items())
    print(f"{counts.total()} kills ({by_moment} a write) in {trials} trials, {time.monotonic() - begin:.0f} s: "
          f"{wrong} ended differently")  # fmt: skip
    return 1 if wrong else 0


def _undisturbed(scene: Path, out: Path, words: Sequence[str]) -> tuple[set[tuple[str, str]], float, int]:
    """State of the training that is let be, its seconds, and the number of its writes."""
    shutil.rmtree(out, ignore_errors=True)
    _wait(_start(scene, out, words, _without_resume), out)  # the first one warms caches up
    expected = _state(out)
    shutil.rmtree(out)
    begin, counter = time.monotonic(), out.parent / "writes"
    counter.unlink(missing_ok=True)
    _wait(_start(scene, out, words, lambda: _at_write(lambda *_: counter.open("a").write("x"))), out)
    if differences := expected ^ _state(out):
        raise RuntimeError(f"--resume alone changes {sorted(differences)}")
    return expected, time.monotonic() - begin, len(counter.read_text()) // len(MOMENTS)


def _without_resume() -> None:
    """Let a training write no checkpoint that was not asked for, but the last."""
    resume.LEAST = float("inf")


def _trial(rng: random.Random, scene: Path, out: Path, words: Sequence[str], seconds: float, writes: int) -> list[str]:
    """Train with one to MOST kills and a last run without; return what was done. Fewer if a run ends before."""
    done = []
    for _ in range(rng.randint(1, MOST)):
        if rng.random() < 0.5:
            child, delay = _start(scene, out, words, lambda: None), rng.uniform(0, seconds)
            what = f"random {delay:.2f} s"
            time.sleep(delay)
            os.kill(child, signal.SIGKILL)
        else:
            moment, number = rng.choice(MOMENTS), rng.randrange(writes)
            what = f"{moment} write {number}"
            child = _start(scene, out, words, lambda m=moment, n=number: _at_write(_killer(m, n)))
        status = os.waitpid(child, 0)[1]
        if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL:
            done.append(what)
        elif status == 0:
            break  # it was faster, or has fewer writes when resumed
        else:
            raise RuntimeError(f"a training ended with status {status} after {done}: {_errors(out)}")
    _wait(_start(scene, out, words, lambda: None), out)  # which does nothing where the training is finished
    return done


def _start(scene: Path, out: Path, words: Sequence[str], prepare: Callable[[], Any]) -> int:
    """Fork a training that resumes from the newest checkpoint, and return its process."""
    child = os.fork()
    if child:
        return child
    status = 1
    try:
        resume.LEAST, resume.SHARE, resume.EVERY = 0.0, float("inf"), 5
        prepare()
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(os.open(out.parent / "errors", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
        train.summary_writer = lambda folder: None
        torch.set_num_threads(1)
        train.main(["-s", str(scene), "-m", str(out), *OPTIONS, *words])
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(status)


def _wait(child: int, out: Path) -> None:
    if status := os.waitpid(child, 0)[1]:
        raise RuntimeError(f"a training that was let be ended with status {status}: {_errors(out)}")


def _errors(out: Path) -> str:
    return (out.parent / "errors").read_text(errors="replace")[-2000:]


def _at_write(act: Callable[[str, int, Path], Any]) -> None:
    """Let `act` be called before, in and after each renaming of a temporary file, with its number and path."""
    replace, count = os.replace, [0]

    def watched(source: Path, target: Path) -> None:
        number = count[0]
        count[0] += 1
        act("before", number, source)
        act("in", number, source)
        replace(source, target)
        act("after", number, source)

    utils.system_utils.os.replace = watched


def _killer(moment: str, number: int) -> Callable[[str, int, Path], None]:
    def act(now: str, at: int, source: Path) -> None:
        if (now, at) == (moment, number):
            if now == "in":  # as if only half had been written
                os.truncate(source, os.path.getsize(source) // 2)
            os.kill(os.getpid(), signal.SIGKILL)

    return act


def _state(out: Path) -> set[tuple[str, str]]:
    """The names of all files, each with a digest of what training determines in it."""
    state = set()
    for path in filter(Path.is_file, out.rglob("*")):
        content = b""
        if path.suffix == ".ply" or path.name in ("cameras.json", "exposure.json"):
            content = path.read_bytes()
        elif path.suffix == ".pth" and ".tmp" not in path.name:
            content = repr(leaves(torch.load(path, weights_only=True))).encode()
        state.add((str(path.relative_to(out)), hashlib.sha256(content).hexdigest()))
    return state


if __name__ == "__main__":
    sys.exit(main())
