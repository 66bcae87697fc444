"""Results of convert.py on sets of photos: seconds, photos placed, errors of places and lenses, and PSNR.

    python -m benchmarks.scenes.conversion SCENES --rows fox_raw bonsai400/2 --train 60
    python -m benchmarks.scenes.conversion SCENES --rows fox_raw bonsai_small --train 20 --figure stages.png

SCENES is as DIR of benchmarks.scenes.captures, which makes the sets. Rows take turns on all checkouts. A place's error
is a share of the mean distance of the true cameras from their middle, after a robust similarity. `strangers` are photos
that were placed though they have no place beside the others. `rotation` is the error that rotations alone leave, as a
share of the longer side, `alike` the number of photos that lie upon photos of other things. The PSNR is of the test
photos after a training on the result, and on the true poses of the same photos, as they were before undistortion. The
seconds of the stages end with those of the training's command and of a page; `rest` is what convert.py needs for its
start and its report.
"""

import argparse
import json
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from PIL import Image

from benchmarks.harness.measuring import describe_machine, print_table
from benchmarks.scenes.captures import make, restrict_model
from splatting.records.figures import save_figure
from splatting.records.model_folder import curve_of
from utils.system_utils import UserError, run_cli

if TYPE_CHECKING:
    import pycolmap

_ROOT = Path(__file__).resolve().parents[2]
_WRONG = 0.03  # share of the mean distance from the middle; places that are off by more are wrong
_DRAWS, _REFITS = 1000, 10
_SMALL = (48, 36)  # of frames that are compared
# From photos to a page, as far as they take time.
STAGES = ("video", "photos", "features", "matching", "mapping", "undistortion", "resize", "orient", "rest")
STAGES += ("training", "page")
# A small process starts the command: a process's peak counts that of the one that started it.
_PEAK = """import resource, subprocess, sys
status = subprocess.call(sys.argv[2:])
open(sys.argv[1], "w").write(str(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss))
sys.exit(status)"""


class Row(NamedTuple):
    """A set of photos, by its name in captures.py with / for _, and options of convert.py.

    {set} stands for the set's folder.
    """

    name: str
    options: str = ""

    @property
    def set(self) -> str:
        return self.name.replace("/", "_")


_SEQUENTIAL, _GLOBAL = "--matcher sequential", "--mapper global"
ROWS = [
    *(Row("bonsai400/2", options) for options in ("", "--camera SIMPLE_RADIAL", _GLOBAL)),
    *(Row("bonsai400/1", options) for options in (_SEQUENTIAL, f"{_SEQUENTIAL} {_GLOBAL}")),
    *(Row("bonsai800/4", options) for options in ("", _GLOBAL)),
    Row("bonsai800/2", _GLOBAL),
    *(Row("bonsai800/1", options) for options in ("", _SEQUENTIAL, f"{_SEQUENTIAL} {_GLOBAL}")),
    *map(Row, ("bonsai3200/1", "tt_train", "fox_full", "fox_raw", "monstree_raw", "bonsai_small")),
    Row("video", "--video {set}/video.mp4"),
    *map(Row, ("rooms", "phone", "corridor", "two_places", "mirrored", "foreign", "turntable")),
    *map(Row, ("turning0", "turning1", "turning3", "turning30", "poster", "twin_box")),
    *map(Row, ("crops375", "crops1500")),
]


@dataclass
class Places:
    """Placed photos beside their true poses. errors: shares; turn: degrees, median; focal: found and true, pixels."""

    errors: np.ndarray
    turn: float
    focal: tuple[float, float]
    strangers: int


@dataclass
class Result:
    """A conversion. said: last line of its stderr; report: of convert_report.json; peak: MiB of the largest process.

    later: seconds of training and page.
    """

    seconds: float
    status: int
    said: str
    peak: float
    report: dict[str, Any] = field(default_factory=dict)
    places: Places | None = None
    psnr: tuple[float | None, float | None] = (None, None)
    later: dict[str, float] = field(default_factory=dict)

    @property
    def stages(self) -> dict[str, float]:
        """Seconds of each stage of STAGES, as far as they are known."""
        told = self.report.get("seconds") or {}
        return told and told | {"rest": self.seconds - sum(told.values())} | self.later


def convert(photos: Path, run: Path, options: Sequence[str], checkout: Path) -> Result:
    """Convert a set in a new folder `run`, which links to its photos, by the convert.py of a checkout."""
    shutil.rmtree(run, ignore_errors=True)
    run.mkdir(parents=True)
    if (photos / "input").is_dir():
        (run / "input").symlink_to((photos / "input").resolve())
    command = [sys.executable, "-c", _PEAK, str(run / "peak.txt"), sys.executable, str(checkout / "convert.py")]
    start = time.perf_counter()
    done = subprocess.run([*command, "-s", str(run), *options], cwd=checkout, capture_output=True, text=True)
    seconds = time.perf_counter() - start
    (run / "said.txt").write_text(done.stdout + done.stderr)
    lines = [line.rsplit("\r", 1)[-1].strip() for line in done.stderr.split("\n")]
    said = next((line for line in reversed(lines) if line), f"exit status {done.returncode}")
    result = Result(seconds, done.returncode, said, int((run / "peak.txt").read_text()) / 1024)
    if (run / "sparse" / "0").is_dir() and (run / "convert_report.json").is_file():
        result.report = json.loads((run / "convert_report.json").read_text())
    return result


def read_truth(photos: Path, run: Path) -> "pycolmap.Reconstruction | None":
    """The true poses of a set, by the names of the photos in `run`; None if they are not known."""
    import pycolmap  # after Pillow

    if not (photos / "truth").is_dir():
        return None
    truth = pycolmap.Reconstruction(str(photos / "truth"))
    if not (photos / "frames").is_dir():
        return truth
    # convert.py numbers the frames that it takes anew, and they look like themselves.
    frames = sorted((photos / "frames").iterdir())
    small = np.stack(list(map(_shrink, frames)))
    taken = sorted((run / "input").iterdir())
    return restrict_model(truth, {frames[np.abs(small - _shrink(path)).sum(1).argmin()].name: path for path in taken})


def _shrink(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("L").resize(_SMALL, Image.Resampling.BOX), dtype=np.float32).ravel()


def fit_similarity(of: np.ndarray, to: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The scaled rotation (3, 3) and the shift (3,) that take points (N, 3) to others by least squares (Umeyama 1991).

    It mirrors nothing.
    """
    middle, other = of.mean(0), to.mean(0)
    u, sizes, v = np.linalg.svd((to - other).T @ (of - middle))
    signs = np.array([1, 1, np.sign(np.linalg.det(u @ v))])
    spread = np.square(of - middle).sum()
    turned = (u * signs) @ v * ((sizes * signs).sum() / spread if spread else 1.0)
    return turned, other - turned @ middle


def measure_errors(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Distances (N,) of places (N, 3), N at least 3, after the similarity on which most agree, as shares of the radius.

    The best of many draws of three places, by the sum of the errors up to _WRONG (MSAC), then least squares on those
    that agree.
    """
    radius, rng = np.linalg.norm(true - true.mean(0), axis=1).mean(), np.random.default_rng(0)

    def after(chosen: np.ndarray) -> np.ndarray:
        turned, shift = fit_similarity(found[chosen], true[chosen])
        return np.linalg.norm(found @ turned.T + shift - true, axis=1) / radius

    def cost(errors: np.ndarray) -> float:
        return np.minimum(errors, _WRONG).sum()

    best = min((after(rng.choice(len(found), 3, replace=False)) for _ in range(_DRAWS)), key=cost)
    for _ in range(_REFITS):
        best = min(best, after(find_agreeing(best)), key=cost)
    return best


def find_agreeing(errors: np.ndarray) -> np.ndarray:
    """Return a mask (N,) of the places that are right, or, where most are wrong, of the better half."""
    return errors <= max(_WRONG, float(np.median(errors)))


def compare_poses(found: "pycolmap.Reconstruction", truth: "pycolmap.Reconstruction") -> Places | None:
    """Compare the photos of a model with their true poses; None if fewer than three have one."""
    ours, theirs = ({image.name: image for image in of.images.values() if image.has_pose} for of in (found, truth))
    names = sorted(ours.keys() & theirs.keys())
    if len(names) < 3:
        return None
    pairs = [(ours[name], theirs[name]) for name in names]
    centers = np.array([[image.projection_center() for image in pair] for pair in pairs])
    errors = measure_errors(centers[:, 0], centers[:, 1])
    turns = np.array([[image.cam_from_world().rotation.matrix() for image in pair] for pair in pairs])
    # The turn between the worlds, by the cameras: places on a line leave it open.
    right = turns[find_agreeing(errors)]
    u, _, v = np.linalg.svd((right[:, 1].transpose(0, 2, 1) @ right[:, 0]).sum(0))
    between = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    off = np.linalg.norm(turns[:, 1] @ between - turns[:, 0], axis=(1, 2))
    degrees = np.degrees(2 * np.arcsin(np.clip(off / np.sqrt(8), 0, 1)))
    focal = np.median([[image.camera.mean_focal_length() for image in pair] for pair in pairs], axis=0)
    return Places(errors, float(np.median(degrees)), tuple(focal), len(ours) - len(names))


def write_official(run: Path, found: "pycolmap.Reconstruction", truth: "pycolmap.Reconstruction") -> Path:
    """Write a scene of the placed photos as they were, with their true poses, and return its folder."""
    placed = {image.name for image in found.images.values()} & {image.name for image in truth.images.values()}
    out = run / "official"
    (out / "sparse" / "0").mkdir(parents=True)
    (out / "images").symlink_to((run / "input").resolve())
    photos = {name: run / "input" / name for name in placed}
    restrict_model(truth, photos).write_binary(str(out / "sparse" / "0"))
    return out


def trained_psnr(scene: Path, model: Path, seconds: float) -> float | None:
    """The PSNR (dB) of all test photos after so many seconds of training; None if the training failed."""
    words = ["-s", str(scene), "-m", str(model), "--eval", "--time_budget", f"{seconds:g}", "--disable_viewer"]
    command = [sys.executable, str(_ROOT / "train.py"), *words, "--quiet"]
    done = subprocess.run(command, cwd=_ROOT, capture_output=True, text=True)
    if done.returncode:
        print(f"warning: the training of {scene} failed:\n{done.stderr[-2000:]}", file=sys.stderr)
        return None
    return next((row["test_psnr"] for row in reversed(curve_of(model)) if row["subset"] is None), None)


def page_seconds(model: Path, page: Path) -> float:
    """The seconds of export.py for a page. UserError if it fails."""
    start = time.perf_counter()
    command = [sys.executable, str(_ROOT / "export.py"), "-m", str(model), "--to", str(page), "--quiet"]
    done = subprocess.run(command, cwd=_ROOT, capture_output=True, text=True)
    if done.returncode:
        raise UserError(f"the export of {model} failed:\n{done.stderr[-2000:]}")
    return time.perf_counter() - start


def measure_conversion(photos: Path, run: Path, options: Sequence[str], checkout: Path, seconds: float) -> Result:
    """Convert a set, compare the result with its truth, and train on it for some seconds, if they are not 0."""
    import pycolmap

    result = convert(photos, run, options, checkout)
    if not result.report:
        return result
    found, truth = pycolmap.Reconstruction(str(run / "sparse" / "0")), read_truth(photos, run)
    result.places = compare_poses(found, truth) if truth else None
    if seconds:
        official = write_official(run, found, truth) if result.places else None
        start = time.perf_counter()
        ours = trained_psnr(run, run / "model", seconds)
        result.later["training"] = time.perf_counter() - start
        if ours is not None:
            result.later["page"] = page_seconds(run / "model", run / "page.html")
        result.psnr = ours, trained_psnr(official, run / "official_model", seconds) if official else None
    return result


HEADER = [
    *("set", "options", "photos", "s", "placed", "named", "error, %", "90 %", "most", "off", "strangers", "degrees"),
    *("focal, px", "true", "rotation, %", "alike", "status", "MiB"),
]


def format_cells(result: Result) -> list[str]:
    """A result's cells below HEADER, from the photos on."""
    report, places = result.report, result.places
    photos, placed, named, compared, judged = "", result.said, "", [""] * 8, ["", ""]
    if report:
        found = (report.get("tried") or [{}])[0]
        judged = [f"{100 * found['rotation']:.2f}" if found.get("rotation") else "", str(len(found.get("alike", ())))]
        photos, placed, named = map(str, (report["photos"], report["registered"], len(report["left_out"])))
    if places:
        shares = 100 * places.errors
        errors = [f"{value:.2f}" for value in (np.median(shares), np.percentile(shares, 90), shares.max())]
        counts = [str((places.errors > _WRONG).sum()), str(places.strangers)]
        compared = [*errors, *counts, f"{places.turn:.2f}", *(f"{value:.1f}" for value in places.focal)]
    ended = [str(result.status), f"{result.peak:.0f}"]
    return [photos, f"{result.seconds:.1f}", placed, named, *compared, *judged, *ended]


def list_stages(results: Sequence[Result]) -> list[str]:
    """The stages of any of the results, in order."""
    return [stage for stage in STAGES if any(stage in result.stages for result in results)]


def stage_table(labels: Sequence[list[str]], results: Sequence[Result]) -> list[list[str]]:
    """The seconds of each stage in each conversion that tells them."""
    return [
        [*label, *(f"{result.stages[stage]:.1f}" if stage in result.stages else "" for stage in list_stages(results))]
        for label, result in zip(labels, results, strict=True)
        if result.stages
    ]


def draw(path: Path, labels: Sequence[list[str]], results: Sequence[Result]) -> None:
    """Draw a bar for each conversion, of the seconds of its stages."""
    from matplotlib.figure import Figure

    names = [" ".join(filter(None, label)) for label in labels]
    names = [f"{name}\n{result.report.get('photos', 0)} photos" for name, result in zip(names, results, strict=True)]
    figure = Figure(figsize=(9, 1.4 + 0.55 * len(names)), layout="constrained")
    axes = figure.subplots()
    ends = np.zeros(len(names))
    for number, stage in enumerate(list_stages(results)):
        seconds = np.array([result.stages.get(stage, 0.0) for result in results])
        axes.barh(names, seconds, left=ends, label=stage, color=f"C{number}", height=0.65)
        for row in np.flatnonzero(seconds > 0.04 * max(sum(result.stages.values()) for result in results)):
            axes.text(ends[row] + seconds[row] / 2, row, f"{seconds[row]:.0f}", ha="center", va="center", fontsize=8)
        ends += seconds
    axes.invert_yaxis()
    axes.set_xlabel("seconds")
    figure.legend(loc="outside upper center", ncols=len(STAGES), fontsize=8, frameon=False)
    save_figure(figure, path, 100)


def main() -> None:
    """Convert the sets, print results and stages, and draw the stages if asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    names = list(dict.fromkeys(row.name for row in ROWS))
    add("scenes", type=Path, help="folder of the COLMAP scenes")
    add("--rows", nargs="+", choices=names, default=names, metavar="NAME", help=f"sets (default: {', '.join(names)})")
    add("--out", type=Path, default=_ROOT / "build" / "conversion", help="folder for sets, which stay, and results")
    add("--train", type=float, default=0, metavar="SECONDS", help="of each training for the PSNR (default: none)")
    add("--figure", type=Path, metavar="PNG", help="draw the seconds of the stages as bars")
    add("--options", default="", help="further ones of convert.py, as --options='...'")
    add("--checkout", type=Path, nargs="+", default=[_ROOT], metavar="DIR", help="code that converts (default: this)")
    args = parser.parse_args()
    if missing := [folder for folder in args.checkout if not (folder / "convert.py").is_file()]:
        raise UserError(f"{missing[0]} has no convert.py; name a checkout of this project")
    out, several = args.out.resolve(), args.checkout != [_ROOT]
    labels, results = [], []
    for row in (row for row in ROWS if row.name in args.rows):
        photos = make(row.set, args.scenes.resolve(), out / "sets")
        for number, checkout in enumerate(args.checkout):
            options = f"{row.options} {args.options}".strip()
            folder = re.sub(r"\W+", "_", f"{row.name} {options} {number or ''}").strip("_")
            words = shlex.split(options.replace("{set}", shlex.quote(str(photos))))
            result = measure_conversion(photos, out / "runs" / folder, words, checkout.resolve(), args.train)
            labels.append([*([str(checkout)] if several else []), row.name, options.replace("{set}/", "")])
            results.append(result)
            shown = filter(None, [*labels[-1], *format_cells(result), *result.psnr])
            print(*shown, sep="  ", file=sys.stderr, flush=True)
    scored = [[f"{psnr:.2f}" if psnr is not None else "" for psnr in result.psnr] for result in results]
    code = ["code"] if several else []
    print(describe_machine())
    header = [*code, *HEADER, *(["PSNR, dB", "true poses"] if args.train else [])]
    rows = zip(labels, results, scored, strict=True)
    print_table(
        header, [[*label, *format_cells(result), *(psnr if args.train else [])] for label, result, psnr in rows]
    )
    if seconds := stage_table(labels, results):
        print()
        print_table([*code, *HEADER[:2], *(f"{stage}, s" for stage in list_stages(results))], seconds)
    if args.figure:
        draw(args.figure, labels, results)


if __name__ == "__main__":
    run_cli(main)
