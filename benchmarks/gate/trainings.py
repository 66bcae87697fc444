"""Trainings of the gate: three scenes, each by this code, and by an older build in turns with it."""

import io
import os
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from applications.demo.make_scene import make_scene
from applications.evaluation import stages
from applications.evaluation.child import Finished, run_child
from applications.evaluation.plan import SceneEntry, plan_runs
from applications.evaluation.results import MB, read_run
from splatting.records.model_folder import trained_iterations
from utils.system_utils import UserError

ROOT = Path(__file__).resolve().parents[2]
WORK = ROOT / "build" / "gate"
REAL = {"fox_tiny": [], "bonsai_small": [], "nerf_lego200_tiny": ["-w"]}
# Made where the real ones are missing. Arguments of make_scene, and options of train.py.
MADE = {
    "demo": ((40, 200, 150, 8000, 0), []),
    "demo_few_points": ((24, 200, 150, 800, 1), ["--random_background"]),
    "demo_large": ((24, 320, 240, 8000, 2), ["--antialiasing"]),
}


class Task(NamedTuple):
    """A scene and the options that it is trained with."""

    scene: Path
    options: list[str]


def list_tasks(iterations: int) -> dict[str, Task]:
    """Return the real scenes below $GS_SHARED or beside the repository if all are there, else made ones, by name."""
    real = Path(os.environ.get("GS_SHARED") or ROOT.parent / "shared") / "scenes"
    length = ["--iterations", str(iterations), "--no_curve"]
    if all((real / name).is_dir() for name in REAL):
        return {name: Task(real / name, [*length, *options]) for name, options in REAL.items()}
    made = {}
    for name, (arguments, options) in MADE.items():
        folder = WORK / "scenes" / name
        if not folder.is_dir():
            make_scene(folder, *arguments)
        made[name] = Task(folder, [*length, *options])
    return made


class Build(NamedTuple):
    """A checkout of an older commit and the folder of its extensions, None: those that are installed are the same."""

    folder: Path
    site: Path | None

    def run(self, command: Sequence[str], _: str = "", **environment: str) -> Finished:
        """Run a program of the repository, as this checkout has it."""
        environment |= {} if self.site is None else {"PYTHONPATH": str(self.site)}
        return run_child([command[0], str(self.folder / Path(command[1]).name), *command[2:]], **environment)


HERE = Build(ROOT, None)


def build_older(commit: str) -> Build:
    """Check a commit out below build/gate and build its extensions, if they differ from those here.

    UserError if git has no such commit.
    """
    folder = WORK / commit
    if not folder.is_dir():
        archive = subprocess.run(["git", "archive", commit], cwd=ROOT, capture_output=True)
        if archive.returncode:
            raise UserError(f"git has no commit {commit} here; fetch the whole history: git fetch --unshallow")
        WORK.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=WORK) as work:
            with tarfile.open(fileobj=io.BytesIO(archive.stdout)) as files:
                files.extractall(work, filter="data")
            if not _has_same_extensions(commit):
                _build_extensions(Path(work))
            Path(work).rename(folder)
            Path(work).mkdir()  # for the end of the context
    site = folder / "site"
    return Build(folder, site if site.is_dir() else None)


def _has_same_extensions(commit: str) -> bool:
    return subprocess.run(["git", "diff", "--quiet", commit, "--", "submodules"], cwd=ROOT).returncode == 0


def _build_extensions(folder: Path) -> None:
    """Build the extensions of a checkout into its folder `site`. UserError if they do not compile.

    folder: checkout of the stored build.
    """
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation"]
    names = ("simple-knn", "fused-ssim", "diff-gaussian-rasterization")
    done = subprocess.run(
        [*pip, "--target", str(folder / "site"), *(f"./submodules/{name}" for name in names)],
        cwd=folder, capture_output=True, text=True,
    )  # fmt: skip
    if done.returncode:
        raise UserError(f"the extensions of the stored build do not compile here:\n{done.stderr[-2000:]}")


def read_head() -> str:
    """Return the commit of this checkout. UserError if files differ from it, since it could not be built again."""
    status = ["git", "status", "--porcelain", "--untracked-files=no"]
    changed = subprocess.run(status, cwd=ROOT, capture_output=True, text=True)
    commit = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True)
    if commit.returncode or changed.stdout:
        raise UserError("a baseline is of a commit, but files here differ from it; commit or remove the changes first")
    return commit.stdout.strip()


def train_and_score(task: Task, seed: int) -> dict[str, float]:
    """Train by this code, render and score the test views."""
    found = _train_and_report(task, seed, HERE, scores=True)
    counts = {"seed": seed, "Gaussians": found["gaussians"], "bytes": round(MB * found["ply_mb"])}
    return counts | {name: found[name] for name in ("PSNR", "SSIM", "seconds")}


def train_and_time(task: Task, seed: int, build: Build | None) -> float:
    """Return the training seconds of this code (None) or of an older build."""
    return _train_and_report(task, seed, build or HERE)["seconds"]


def _train_and_report(task: Task, seed: int, build: Build, scores: bool = False) -> dict[str, float]:
    """Train as full_eval.py does; what its report tells of the last iteration."""
    with tempfile.TemporaryDirectory() as folder:
        scene = SceneEntry(task.scene.name, "scenes", task.scene)
        (run,) = plan_runs([scene], Path(folder), task.options, {}, [seed])
        try:
            stages.train(run, {}, build.run)
            if scores:
                stages.render(run, (), build.run)
                stages.score(run, build.run, download=False)
        except stages.StageFailed as failed:
            raise UserError(f"{task.scene.name}: {failed.failure.stage} failed: {failed}") from failed
        return read_run(run, Path(folder), None)["iterations"][str(trained_iterations(run.model)[-1])]
