"""Stand-ins for the programs that full_eval.py starts: they write the files of train.py, render.py and so on at once.

`run` does so in this process. `python tests/stand_ins.py train.py ...` does so as a program, which can be interrupted.
`run_here` runs the real programs in this process, which has imported torch: that takes longer than a short training.
"""

import argparse
import json
import os
import signal
import sys
import time
from importlib import import_module
from pathlib import Path
from unittest import mock

from PIL import Image

from applications.evaluation.child import Finished, Slot, run_child


def _parsed(words: list[str], **options: object) -> argparse.Namespace:
    """The options that a stand-in knows, with their defaults; a default is a list, a flag, or of the option's type."""
    parser = argparse.ArgumentParser()
    parser.add_argument("-s", type=Path)
    parser.add_argument("-m", type=Path)
    for name, default in options.items():
        kind = {"action": "store_true"} if default is False else {"default": default}
        if isinstance(default, list):
            kind |= {"nargs": "+", "type": int}
        elif isinstance(default, int | float) and default is not False:
            kind |= {"type": type(default)}
        parser.add_argument(f"--{name}", **kind)
    return parser.parse_known_args(words)[0]


def _note(args: argparse.Namespace, name: str, words: list[str]) -> None:
    if args.s:
        with (args.s.parent / "calls.txt").open("a") as calls:
            calls.write(json.dumps([name, *words]) + "\n")


def _save(model: Path, iteration: int, degree: int) -> None:
    ply = model / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"
    ply.parent.mkdir(parents=True, exist_ok=True)
    ply.write_text(f"ply\nelement vertex {100 * iteration * (1 + degree)}\nend_header\n")


def train(words: list[str], _: dict[str, str]) -> None:
    """Numbers depend on the options.

    With --time_budget it ends three iterations later than with --iterations, and three more for each seed above 0. A
    file `broken` in the scene folder makes it fail, `full` makes it fail and leave a checkpoint, `slow` makes it wait
    for a signal.
    """
    args = _parsed(words, iterations=30000, sh_degree=3, seed=0, time_budget=0.0, start_checkpoint=None,
                   save_iterations=[7000, 30000])  # fmt: skip
    end = args.iterations + (3 + 3 * args.seed if args.time_budget else 0)
    _note(args, "train", words)
    args.m.mkdir(parents=True, exist_ok=True)
    if (args.s / "broken").exists():
        sys.exit("error: <b>the scene</b> is broken; fix it")
    if (args.s / "full").exists():
        (args.m / "chkpnt9.pth").write_bytes(b"")
        sys.exit("error: training ran out of memory")
    if (args.s / "slow").exists() and not args.start_checkpoint:
        _wait_for_a_signal(args)

    best = 20.0 + args.sh_degree + 0.1 * args.seed  # dB at the end
    slowness = 1 + args.sh_degree  # seconds an iteration, times ten
    scores = ",".join(f"{views}_{score}" for views in ("test", "train") for score in ("l1", "psnr", "ssim"))
    rows = [f"iteration,seconds,wall_seconds,gaussians,peak_memory_mib,{scores}"]
    for t in (end // 4, end // 2, end):
        progress = t / end
        cost = f"{t},{t * slowness / 10},{t},{100 * t * slowness},{300 + t}"
        rows.append(f"{cost},0.1,{best - 10 + 10 * progress},{0.7 + 0.2 * progress},0.1,30,0.95")
    (args.m / "error_vs_time.csv").write_text("\n".join(rows) + "\n")
    (args.m / "stand_in.json").write_text(json.dumps({"psnr": best}))
    (args.m / "cameras.json").write_text(json.dumps([{"img_name": f"photo_{i}.jpg"} for i in range(9)]))
    log = []
    for t in sorted({*args.save_iterations, end}):
        if t <= end:
            _save(args.m, t, args.sh_degree)
            log.append({"iteration": t, "seconds": t * slowness / 10})
    (args.m / "train_log.json").write_text(json.dumps(log))


def _wait_for_a_signal(args: argparse.Namespace) -> None:
    """In a process of its own, wait for a signal; in that of the test, behave as if one had come."""
    (args.m / "pid").write_text(str(os.getpid()))

    def stop(signum: int, _: object = None) -> None:
        (args.m / ("chkpnt41.pth" if args.time_budget else "chkpnt5.pth")).write_bytes(b"")
        _save(args.m, 41 if args.time_budget else 5, args.sh_degree)
        sys.exit(128 + signum)

    if __name__ != "__main__":
        stop(signal.SIGINT)

    def stop_once(signum: int, _: object) -> None:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: sys.exit("two signals: no checkpoint"))
        time.sleep(0.5)
        stop(signum)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop_once)
    (args.s / "started").touch()
    time.sleep(600)
    sys.exit("no signal came")


def render(words: list[str], _: dict[str, str]) -> None:
    """Two grey test views, with a brighter stripe in the renders."""
    args = _parsed(words, iteration="")
    _note(args, "render", words)
    folder = args.m / "test" / f"ours_{args.iteration}"
    for side in ("gt", "renders"):
        (folder / side).mkdir(parents=True, exist_ok=True)
        for index in range(2):
            image = Image.new("RGB", (120, 80), (90, 90, 90))
            if side == "renders":
                image.paste((110, 90, 90), (0, 0, 120, 20))
            image.save(folder / side / f"{index:05d}.png")
    (folder / "render_times.json").write_text(json.dumps({"median_ms": 4.0, "fps": 250.0}))


def metrics(words: list[str], environment: dict[str, str]) -> None:
    """The PSNR that `train` left, and less for the second view."""
    args = _parsed(words, weights=None, error_maps=False, stlpips=False)
    with (args.m / "scored.txt").open("a") as calls:
        calls.write(json.dumps([environment.get("GS_DOWNLOAD"), *words]) + "\n")
    psnr = json.loads((args.m / "stand_in.json").read_text())["psnr"]
    means, per_view = {}, {}
    for folder in (args.m / "test").iterdir():
        means[folder.name] = {"SSIM": 0.9, "PSNR": psnr, "LPIPS": None} | ({"DISTS": 0.125} if args.weights else {})
        means[folder.name] |= {"STLPIPS": 0.25} if args.stlpips else {}
        per_view[folder.name] = {"PSNR": {"00000.png": psnr + 1, "00001.png": psnr - 1}}
    for name in ("00000.jpg", "00001.jpg") if args.error_maps else ():
        (folder / "errors").mkdir(exist_ok=True)
        (folder / "errors" / name).touch()
    (args.m / "results.json").write_text(json.dumps(means))
    (args.m / "per_view.json").write_text(json.dumps(per_view))
    (args.m / "metrics_info.json").write_text(json.dumps({"conventions": {"PSNR": "dB"}}))


def export(words: list[str], _: dict[str, str]) -> None:
    """An empty page."""
    args = _parsed(words, to="")
    _note(args, "export", words)
    Path(args.to).write_text("<!DOCTYPE html>")


PROGRAMS = {"train": train, "render": render, "metrics": metrics, "export": export}


def run(command: list[str], say: str = "", slot: Slot | None = None, **environment: str) -> Finished:
    """Return the result of `run_child` for a stand-in. An exit of 130 also counts as an interrupt of full_eval.py."""
    start = time.perf_counter()
    if say and not slot:
        print(f"  {say}")
    try:
        PROGRAMS[Path(command[1]).stem](command[2:], environment)
    except SystemExit as ended:
        status = ended.code if isinstance(ended.code, int) else 1
        interrupt = KeyboardInterrupt if status == 130 else None
        return Finished(status, [str(ended.code)], time.perf_counter() - start, 1.0, interrupt)
    return Finished(0, [], time.perf_counter() - start, 1.0, None)


def run_as_programs(command: list[str], say: str = "", slot: Slot | None = None, **environment: str) -> Finished:
    """The same in a process of its own."""
    environment |= {"PYTHONPATH": str(Path(__file__).parents[1])}
    return run_child([sys.executable, __file__, Path(command[1]).name, *command[2:]], say, slot, **environment)


def run_here(command: list[str], say: str = "", slot: Slot | None = None, **environment: str) -> Finished:
    """Return the result of `run_child` for a real program that ends without an error; any other error is raised."""
    start = time.perf_counter()
    stdout = mock.patch.object(sys, "stdout", sys.stdout)  # training stamps it
    with stdout, mock.patch.object(sys, "argv", command[1:]), mock.patch.dict(os.environ, environment):
        import_module(Path(command[1]).stem).main()
    return Finished(0, [], time.perf_counter() - start, 1.0, None)


if __name__ == "__main__":
    PROGRAMS[Path(sys.argv[1]).stem](sys.argv[2:], dict(os.environ))
