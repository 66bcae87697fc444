"""Scenes with one fault each: what it costs, what it looks like, what the checks say of it, and what helps.

    python -m benchmarks.scenes.failing OUT blur forward

makes each scene, trains it and its twin without the fault on the CPU in a few seconds, and trains it again with each
remedy. All are ray traced: scores are those of true pictures, also of what no photo shows. OUT/pictures has, side by
side, the truth, the twin, and the faulty one without and with its best remedy.
"""

import argparse
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from benchmarks.harness.colmap_part import part
from benchmarks.harness.measuring import describe, print_table
from benchmarks.scenes.made import VIEWS, made, with_wall
from scene.readers.info import HOLD
from splatting.demo.make_scene import Things, write_scene
from splatting.demo.objects import Thing, demo_scene
from splatting.demo.tracer import TARGET, View, look_at, ring_views
from splatting.evaluation.comparison import BESIDE
from utils.system_utils import UserError, run_cli

_ROOT = Path(__file__).resolve().parents[2]
_SIZE, _POINTS = (240, 180), 8000
_TRAINING = ["--strategy", "budget", "--max_num_splats", "20000", "--schedule", "400"]
_SHAKE, _SPAN = 12, 2.4  # pixels that a photo is smeared over; what cameras with little overlap aim at, in units
_STEP, _BAR = 0.16, 0.02  # from bar to bar of the fence; a bar's width
_NEAR, _FAR = 0.6, 2.0  # distances of cameras, as a share of the usual one
_ZOOM = 1.08  # of the wrong focal length
_PICTURE = 150  # pixels of each side of a crop


class Bars:
    """An upright fence in the plane z = -1.7, as `splatting.demo.objects` has shapes."""

    def intersect(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (np.float32(-1.7) - origin[2]) / direction[2]
            x, y = origin[0] + t * direction[0], origin[1] + t * direction[1]
            bar = (np.abs(x) < 1.8) & (y < 0) & (y > -1.1) & ((x % _STEP < _BAR) | (y < -1.08))
        return np.where(bar & (t > 1e-3), t, np.float32(np.inf))

    def normal(self, points: np.ndarray) -> np.ndarray:
        return np.broadcast_to(np.float32([[0], [0], [-1]]), points.shape)


def _demo(_: int | None) -> list[Thing]:
    return demo_scene()


def _fenced(_: int | None) -> list[Thing]:
    grey = np.full((3, 1), 0.25, np.float32)
    return [*demo_scene(), Thing(Bars(), lambda p: np.broadcast_to(grey, p.shape))]


def _mirrored(_: int | None) -> list[Thing]:
    *things, wall = with_wall(None)
    return [*things, replace(wall, mirror=1.0)]


def _around(count: int = VIEWS) -> list[View]:
    return ring_views(count, *_SIZE, np.random.default_rng(0))


def _moved(view: View, center: np.ndarray, target: np.ndarray = TARGET) -> View:
    return View(look_at(center, target), center, view.focal, view.width, view.height)


def _ahead() -> list[View]:
    """Cameras on a line that look ahead; test views stand beside it."""
    views = []
    for k, view in enumerate(_around()):
        aside = 0.0 if k % HOLD else 0.8 * (-1) ** (k // HOLD)
        center = np.array([0.1 + aside, -1.0, -5.5 + 3.2 * k / VIEWS])
        views.append(_moved(view, center, center + [-0.2 * aside, 0.15, 1.0]))
    return views


def _near_and_far() -> list[View]:
    """Test views at both distances, too."""
    shares = [_FAR if k % 3 == 0 else _NEAR for k in range(VIEWS)]
    return [
        _moved(view, TARGET + share * (view.center - TARGET)) for share, view in zip(shares, _around(), strict=True)
    ]


def _apart() -> list[View]:
    """Near cameras that aim at different places."""
    rng, views = np.random.default_rng(0), []
    for view in _around(16):
        aim = TARGET + [1, 0.2, 1] * rng.uniform(-_SPAN / 2, _SPAN / 2, 3)
        views.append(_moved(view, TARGET + _NEAR * (view.center - TARGET), aim))
    return views


def _traced(views: Callable[[], list[View]], out: Path, things: Things = _demo) -> None:
    write_scene(out, views(), things, _POINTS, np.random.default_rng(0))


def _blurred(out: Path) -> None:
    """The demo, of which every second training photo is smeared along a line."""
    made("clean", out)
    rng, along = np.random.default_rng(0), np.linspace(-_SHAKE / 2, _SHAKE / 2, 4 * _SHAKE + 1)
    for path in _shaken(sorted((out / "images").iterdir())):
        pixels, angle = np.asarray(Image.open(path)).astype(np.float32), rng.uniform(0, np.pi)
        padded = np.pad(pixels, ((_SHAKE, _SHAKE), (_SHAKE, _SHAKE), (0, 0)), "edge")
        moves = np.rint(np.outer(along, [np.sin(angle), np.cos(angle)])).astype(int)
        smeared = np.mean([np.roll(padded, tuple(move), (0, 1)) for move in moves], 0)
        cut = smeared[_SHAKE:-_SHAKE, _SHAKE:-_SHAKE]
        Image.fromarray(np.floor(cut + 0.5).astype(np.uint8)).save(path)


def _shaken(photos: list) -> list:
    return [photo for k, photo in enumerate(photos) if k % HOLD and k % 2]


def _zoomed(out: Path) -> None:
    """The demo with a focal length that is too long."""
    import pycolmap  # after Pillow

    made("clean", out)
    folder = str(out / "sparse" / "0")
    model = pycolmap.Reconstruction(folder)
    for camera in model.cameras.values():
        camera.params = [_ZOOM * camera.params[0], _ZOOM * camera.params[1], *camera.params[2:]]
    model.write_binary(folder)


def _unshaken(scene: Path, out: Path) -> Path:
    """The scene without its smeared photos."""

    def sharp(photos: list) -> list:
        return [photo for photo in photos if photo not in _shaken(photos)]

    return part(scene, out, sharp)


class Case(NamedTuple):
    """A fault: how its scene is made, its twin without the fault, and options that may help.

    judged: the scene whose test views score both; "": each its own.
    """

    make: Callable[[Path], object]
    twin: str = "clean"
    judged: str = "clean"
    remedies: tuple[str, ...] = ()


CASES = {
    "few": Case(
        partial(_traced, partial(_around, 8)),
        remedies=("--sparse_depth 0.1", "--strategy mcmc", "--max_num_splats 8000"),
    ),
    "blur": Case(_blurred, remedies=("without the blurred photos",)),
    "mirror": Case(
        partial(_traced, _around, things=_mirrored), "wall", "", ("--robust_mask 0.3", "--max_num_splats 60000")
    ),
    "fence": Case(partial(_traced, _around, things=_fenced), "clean", "", ("--max_num_splats 60000", "--antialiasing")),
    "exposure": Case(partial(made, "exposure"), remedies=("--appearance ppisp",)),
    "forward": Case(partial(_traced, _ahead), judged="forward", remedies=("--sparse_depth 0.1",)),
    "distances": Case(partial(_traced, _near_and_far), "clean", "", ("--antialiasing", "--filter_3d")),
    "overlap": Case(partial(_traced, _apart), remedies=("--sparse_depth 0.1", "--strategy mcmc")),
    "focal": Case(_zoomed, "clean", "", ("--refine_poses",)),
    "balls": Case(partial(made, "balls"), remedies=("--robust_mask 0.3",)),
}


def _run(script: str, *words: object) -> str:
    done = subprocess.run([sys.executable, str(_ROOT / script), *map(str, words)], capture_output=True, text=True)
    if done.returncode > 1:  # doctor.py gives 1 for a fault that it has found
        raise UserError(f"{script} failed: {done.stderr.strip().splitlines()[-1]}")
    return done.stdout


class Bench:
    """Scenes and models in a folder, each made once."""

    def __init__(self, out: Path) -> None:
        self.out = out

    def scene(self, name: str) -> Path:
        folder = self.out / "scenes" / name
        if not folder.exists():
            CASES[name].make(folder) if name in CASES else made(name, folder)
        return folder

    def pictures(self, name: str, judged: str, remedy: str = "") -> list[tuple[np.ndarray, np.ndarray]]:
        """Renders of a model in the test views of a scene, and the truth."""
        scene, words = self.scene(name), remedy.split()
        if remedy and not remedy.startswith("-"):
            scene, words = self.out / "scenes" / f"{name}_sharp", []
            scene.exists() or _unshaken(self.scene(name), scene)
        model = self.out / "models" / "_".join([name, *remedy.replace("-", "").split()])
        if not model.exists():
            quiet = ["--quiet", "--disable_viewer", "--no_last_checkpoint", "--no_curve"]
            _run("train.py", "-s", scene, "-m", model, "--eval", *quiet, *_TRAINING, *words)
        truth = self.scene(judged or name)
        _run("render.py", "-m", model, "-s", truth, "--allow_other_scene", "--skip_train", "--quiet")
        made_now = [path for path in model.glob("test/*/renders") if not path.parent.name.endswith(BESIDE)]
        folder = max(made_now, key=lambda path: path.stat().st_mtime_ns)
        files = [(path, folder.parent / "gt" / path.name) for path in sorted(folder.iterdir())]
        return [tuple(np.asarray(Image.open(path).convert("RGB")) for path in pair) for pair in files]

    def says(self, name: str) -> tuple[str, str]:
        """What doctor.py finds in a scene, and what --advise recommends."""
        lines = _run("doctor.py", "-s", self.scene(name)).partition("dataset ")[2].splitlines()[1:]
        found = [line.strip() for line in lines if line.startswith("  ") and not line.startswith("  ok")]
        advice = _run("train.py", "-s", self.scene(name), "--eval", "--advise").strip().rpartition(": ")[2]
        return "; ".join(found), advice


def _psnr(pairs: list[tuple[np.ndarray, np.ndarray]]) -> float:
    errors = [np.mean((render / 255 - truth / 255) ** 2) for render, truth in pairs]
    return float(np.mean(-10 * np.log10(errors)))


def judge(bench: Bench, name: str) -> list[str]:
    """A row of the table on a fault, and its picture."""
    case = CASES[name]
    twin, faulty = bench.pictures(case.twin, case.judged), bench.pictures(name, case.judged)
    helped = {remedy: bench.pictures(name, case.judged, remedy) for remedy in case.remedies}
    best = max(helped, key=lambda remedy: _psnr(helped[remedy]))
    view = sorted(range(len(faulty)), key=lambda k: _psnr(faulty[k : k + 1]))[len(faulty) // 3]
    shown = [faulty[view][1], twin[view][0], faulty[view][0], helped[best][view][0]]
    height, width = shown[0].shape[:2]
    top, left = (height - _PICTURE) // 2, (width - _PICTURE) // 2
    strip = np.hstack([image[top : top + _PICTURE, left : left + _PICTURE] for image in shown])
    (bench.out / "pictures").mkdir(exist_ok=True)
    Image.fromarray(strip).save(bench.out / "pictures" / f"fails_{name}.jpg", quality=70, optimize=True)
    after = "; ".join(f"`{remedy}` {_psnr(pairs):.1f}" for remedy, pairs in helped.items())
    return [name, f"{_psnr(twin):.1f}", f"{_psnr(faulty):.1f}", after, *bench.says(name)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="folder for scenes, models and pictures; what is there is kept")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"faults: {', '.join(CASES)}; default: all")
    args = parser.parse_args()
    for name in args.names:
        if name not in CASES:
            raise UserError(f"no fault {name}; name some of {', '.join(CASES)}")
    print(describe())
    rows = [judge(Bench(args.out), name) for name in args.names or CASES]
    print_table(["fault", "without it (dB)", "with it", "with a remedy", "doctor.py", "--advise"], rows)


if __name__ == "__main__":
    run_cli(main)
