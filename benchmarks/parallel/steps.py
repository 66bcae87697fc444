"""Steps of training by one process and by several ranks of one host, side by side: time, and memory of each rank.

    python -m benchmarks.parallel.steps --ranks 1 2
    python -m benchmarks.parallel.steps --ranks 1 2 --workload city --gaussians 5000000 10000000 20000000
    python -m benchmarks.parallel.steps --workload city --crop 3 --model sleep spill --learn --cap 16

A step is that of train.py: draw, loss against a photo, Adam. XL is the workload of the other benchmarks; city has 20 M
Gaussians at 3840x2160, a plane of blocks seen from above, which each rank draws for itself. Every combination of the
options is a case, measured by processes of its own; in each round all cases take a turn, and the best round of each
counts. Steps are timed in blocks, at whose ends the GPU is waited for; the median of the slowest rank is shown.

Learning rates are 0, so that all steps do the same. With --learn they are those of train.py; the table then has digests
of all parameters after the last step, by rank. The last step of a training needs most memory, since it writes
gradients as steps do that add or remove Gaussians. Several numbers of Gaussians give the bytes of one, by a line
through the least and the largest, and how many fit into 92 % of the GPUs. The model `spill` trains with --gpu_memory
of the cap, and blocks sleep, as in `sleep`; shown is the share of SH bands above 0 that the host's memory then has.
"""

import argparse
import hashlib
import itertools
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import torch

from benchmarks.harness.measuring import describe_machine, print_table
from benchmarks.parallel.run import WorkloadRun
from benchmarks.parallel.workload import ALL
from groundwork.host.memory import peak_memory_mib
from groundwork.ranks.ranks import ranks
from scene.gaussian_model import GaussianModel
from scene.gaussians.spilled import bytes_of
from splatting.iteration import Iteration
from splatting.loop import run_training
from splatting.part import Part
from utils.system_utils import UserError, compute_device, run_cli

ROOT = Path(__file__).resolve().parents[2]
HEADER = ["workload", "ranks", "model", "ms a step", "blocks", "images/s", "times the first",
          "peak GiB by rank", "in the last step", "on the host"]  # fmt: skip
_BLOCK = 5  # steps
_PIECE = 1 << 20  # Gaussians that are copied to the host at a time
_USABLE = 0.92  # of a GPU


class Timing(Part):
    """Times blocks of steps after a warm-up, up to an iteration."""

    def __init__(self, device: torch.device, warm_up: int, until: int) -> None:
        self._device, self._first, self._until = device, warm_up, until
        self._ends: list[float] = []
        self.peak_mib = 0.0  # before the last step

    def due(self, at: Iteration) -> bool:
        if at.last:
            self.peak_mib = peak_memory_mib(self._device) or 0.0
        return False

    def stepped(self, at: Iteration) -> None:
        """Note the time at the end of each block of iterations, once the GPU has done them."""
        done = at.iteration - self._first
        if done >= 0 and done % _BLOCK == 0 and at.iteration <= self._until:
            if self._device.type == "cuda":
                torch.cuda.synchronize(self._device)
            self._ends.append(time.perf_counter())

    @property
    def milliseconds(self) -> list[float]:
        """Return the milliseconds of a step, by block."""
        return [1e3 * (end - begin) / _BLOCK for begin, end in itertools.pairwise(self._ends)]


def hash_parameters(gaussians: GaussianModel) -> str:
    """The beginning of the SHA-256 of a rank's parameters."""
    found = hashlib.sha256()
    for name in ("xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation"):
        for piece in gaussians.raw(name).detach().split(_PIECE):
            found.update(piece.cpu().numpy().tobytes())
    return found.hexdigest()[:16]


def measure(case: dict[str, Any]) -> dict[str, Any]:
    """Take the steps of a case in this process, one of its ranks; returns the case and what was found by rank."""
    device, here = compute_device(), ranks()
    spills = case["model"] == "spill"
    if case["cap"] and device.type == "cuda" and not spills:
        total = torch.cuda.get_device_properties(device).total_memory
        torch.cuda.set_per_process_memory_fraction(min(case["cap"] * 2**30 / total, 1.0))
    workload = replace(ALL[case["workload"]].changed(case["gaussians"], case["size"]), crop=case["crop"])
    timed = case["warm_up"] + _BLOCK * case["blocks"]
    model = {"sleep": case["model"] != "gpu", "gpu_memory": case["cap"] * spills}
    run = WorkloadRun(workload, timed + 1, still=not case["learn"], **model)
    if device.type == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    timing = Timing(device, case["warm_up"], timed)
    run.open()
    run_training(run, [run.watch, timing])
    near, far = bytes_of()
    peaks = timing.peak_mib, peak_memory_mib(device) or 0.0
    own = {"ms": timing.milliseconds} | dict(zip(("peak", "last"), (mib + near / 2**20 for mib in peaks), strict=True))
    own["far"] = far / (near + far) if far else 0.0
    own["digest"] = hash_parameters(run.gaussians) if case["learn"] else ""
    own["memory"] = torch.cuda.mem_get_info()[1] if device.type == "cuda" else 0
    count = workload.gaussians
    return case | {"name": str(workload), "gaussians": count, "by_rank": here.all_gather_objects(own)}


def launch(case: dict[str, Any], limit: float) -> dict[str, Any] | None:
    """Measure a case in processes of its own; None if they fail or take longer than `limit` seconds (on stderr)."""
    start = [sys.executable, "-m"]
    if case["ranks"] > 1:
        start += ["torch.distributed.run", "--standalone", f"--nproc_per_node={case['ranks']}", "-m"]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "found.json"
        line = [*start, "benchmarks.parallel.steps", "--case", json.dumps(case), "--found", str(path)]
        with subprocess.Popen(line, cwd=ROOT, stdout=2) as process:  # the table is alone on stdout
            try:
                process.wait(limit)
            except subprocess.TimeoutExpired:
                process.terminate()  # torchrun ends its ranks
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None


def milliseconds(found: dict[str, Any]) -> float:
    """Median of the slowest rank."""
    return max(median(own["ms"]) for own in found["by_rank"])


def make_row(case: dict[str, Any], found: dict[str, Any] | None, first: dict[str, Any] | None) -> list[str]:
    """A row of the table. first: the first case of the same scene; found: None of a case without a result."""
    cells = [f"{case['ranks']}", case["model"]]
    if found is None:
        return [case["workload"], *cells, "failed", *[""] * (len(HEADER) - 4 + case["learn"])]
    step, every = milliseconds(found), found["by_rank"]
    spread = [ms for own in every for ms in own["ms"]]
    cells += [f"{step:.3f}", f"{min(spread):.3f} to {max(spread):.3f}", f"{1e3 / step:.1f}"]
    cells.append(f"{milliseconds(first) / step:.2f}")
    cells += [" ".join(f"{own[name] / 1024:.2f}" for own in every) for name in ("peak", "last")]
    cells.append(" ".join(f"{own['far']:.0%}" for own in every))
    return [found["name"], *cells] + [" ".join(own["digest"] for own in every)] * case["learn"]


def describe_bytes(results: list[dict[str, Any]]) -> list[str]:
    """Sentences on the memory of a Gaussian, from cases that differ in their number of Gaussians alone."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for found in results:
        name = f"{found['workload']}, {found['ranks']} ranks, {found['model']}"
        groups.setdefault(name, []).append(found)
    said = []
    for name, group in groups.items():
        least, most = (pick(group, key=lambda found: found["gaussians"]) for pick in (min, max))
        if least["gaussians"] == most["gaussians"]:
            continue
        for key, when in (("peak", "before the last step"), ("last", "in the last step")):
            low, high = (2**20 * max(own[key] for own in found["by_rank"]) for found in (least, most))
            each = (high - low) / (most["gaussians"] - least["gaussians"])  # on one rank
            said.append(f"{name}: {each * most['ranks']:.0f} bytes a Gaussian {when}")
            if each > 0 and (memory := most["by_rank"][0]["memory"]):
                said[-1] += f", so {(_USABLE * memory - low) / each / 1e6 + least['gaussians'] / 1e6:.0f} M fit"
    return said


def list_cases(args: argparse.Namespace) -> list[dict[str, Any]]:
    """Every combination of the options."""
    same = {name: getattr(args, name) for name in ("size", "crop", "cap", "learn", "warm_up", "blocks")}
    return [
        same | {"workload": workload, "gaussians": count, "ranks": number, "model": model}
        for workload in args.workload
        for count in args.gaussians
        for number in args.ranks
        for model in args.model
    ]


def make_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--ranks", type=int, nargs="+", default=[1], help="numbers of processes (default: 1)")
    add("--workload", nargs="+", choices=list(ALL), default=list(ALL), help="default: all")
    add("--gaussians", type=int, nargs="+", default=[None], help="in place of the workload's")
    add("--size", type=int, nargs=2, metavar=("WIDTH", "HEIGHT"), help="of the image, in place of the workload's")
    add("--crop", type=int, default=1, help="see the middle of so many parts across and down (default: 1)")
    add("--model", nargs="+", choices=["gpu", "sleep", "spill"], default=["gpu"],
        help="where it lies, and whether blocks sleep (default: gpu)")  # fmt: skip
    add("--cap", type=float, default=0.0, help="GiB of a GPU that a process may take (default: all)")
    add("--learn", action="store_true", help="train, and show digests of the parameters")
    add("--warm_up", type=int, default=24, help="steps (default: 24)")
    add("--blocks", type=int, default=20, help=f"of {_BLOCK} steps each (default: 20)")
    add("--rounds", type=int, default=2, help="turns of each case (default: 2)")
    add("--limit", type=float, default=150.0, help="seconds of a case (default: 150)")
    add("--case", type=json.loads, help=argparse.SUPPRESS)
    add("--found", type=Path, help=argparse.SUPPRESS)
    return parser


def main() -> None:
    """Measure one case as a process of torchrun, or launch all cases in turns and print their table."""
    args = make_parser().parse_args()
    if args.case:
        found = measure(args.case)
        if ranks().first:
            args.found.write_text(json.dumps(found), encoding="utf-8")
        return
    if min(*args.ranks, args.crop, args.warm_up, args.blocks, args.rounds) < 1:
        raise UserError("--ranks, --crop, --warm_up, --blocks and --rounds take numbers from 1 on")
    print(describe_machine(compute_device()), flush=True)
    every = list_cases(args)
    turns = [[launch(case, args.limit) for case in every] for _ in range(args.rounds)]
    best = [min(filter(None, of), key=milliseconds, default=None) for of in zip(*turns, strict=True)]
    rows = []
    for case, found in zip(every, best, strict=True):
        first = next((one for one in best if found and one and one["name"] == found["name"]), None)
        rows.append(make_row(case, found, first))
    print_table(HEADER + ["parameters"] * args.learn, rows)
    print("\n".join(describe_bytes([found for found in best if found])))


if __name__ == "__main__":
    run_cli(main, several=True)
