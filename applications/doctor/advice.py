"""Options of train.py that a scene's own data ask for, each with the number that speaks for it.

`train.py --advise` and `doctor.py -s` print them, and `train.py --options auto` takes them.
"""

import argparse
import contextlib
import copy
import io
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from applications.doctor.model import load_scored
from arguments import ModelParams, read_training_options
from arguments.features import options_of
from groundwork.files.json_files import write_json
from groundwork.finding import Finding, note
from groundwork.ranks.ranks import ranks
from scene.checks.scene import findings, report
from scene.gaussian_model import GaussianModel
from scene.readers.info import CameraInfo
from scene.readers.tracks import PhotoPoints, read_tracks
from scene.scene import Scene
from splatting.registry import PARTS, check_together, chosen
from utils.system_utils import UserError, mkdir_p

ADVICE = "advice.json"  # what train.py --advise writes: texts, and options that the scene asks for
GUIDE = "docs/guide/scene_options.md"  # what these options do, gain and cost
DISTANCES = 2.5  # the farthest photo of a point over the nearest
_OFF = (False, "", "none", "off")  # values of options that do nothing; 0 is equal to False
_NOT_OF_DATA = {  # model options that the short training of small photos has itself, or does without
    "sh_degree", "model_path", "resolution", "appearance",
} | {option.name for option in options_of("model")}  # fmt: skip
_WIDTH = 200  # pixels of a photo
_ITERATIONS = 1000  # of the short training
ROOT = Path(__file__).resolve().parents[2]


def advise(dataset: argparse.Namespace, trains: bool = True, warns: bool = False) -> Iterator[Finding]:
    """Advise on a scene, each thing as soon as it is known. dataset: the model options. trains: train shortly, too.

    warns: print what the check of the scene finds, too. UserError as from Scene, and where the scene cannot be trained.
    """
    small = copy.copy(dataset)
    small.resolution, small.model_path = _WIDTH, ""
    vars(small).update({option.name: option.default for option in options_of("model")})
    with contextlib.redirect_stdout(io.StringIO()):  # from the readers
        scene = Scene(small, GaussianModel(0), shuffle=False, start=False)
    if trains:
        report(findings(scene.info, dataset, scene.halves), dataset.source_path, quiet=not warns)
    tracks = read_tracks(dataset.source_path, scene.info.train_cameras, scene.info.offset)
    if any(tracks):
        yield from _check_distances(scene, tracks)
    for part in PARTS:
        yield from part.advise(scene, tracks)
    if trains:
        yield from _train_shortly(dataset)


def asked_options(dataset: argparse.Namespace, args: argparse.Namespace, given: Sequence[str]) -> list[str]:
    """Print the advice on a scene, and return the options that it asks for, as words of a command line.

    args: the options of the training, from the words `given`. Advice on one of these words, and advice that does not go
    with these options, is left out. With --advise their model folder gets ADVICE.
    """
    if ranks().several:
        raise UserError(
            "--advise and --options auto need one process; run train.py --advise without torchrun, and give its options"
        )
    if written := args.advise and dataset.model_path:
        mkdir_p(dataset.model_path)  # if it cannot be, better before the search
    found = []
    for advice in advise(dataset, warns=args.advise):  # a training that follows prints them itself
        print(advice, flush=True)
        found.append(advice)
    found = [_filter_advice(advice, args, given) for advice in found]
    if written:
        write_json(
            Path(dataset.model_path) / ADVICE, [{"text": advice.text, "options": advice.options} for advice in found]
        )
    words = " ".join(advice.options for advice in found).split()
    print(f"{GUIDE} says what each option does, gains and costs")
    print(f"recommended options for this scene, besides those given: {' '.join(words) or 'none'}")
    return words


def _filter_advice(advice: Finding, args: argparse.Namespace, given: Sequence[str]) -> Finding:
    """Return the advice, without its options where one of them is given or where they contradict given ones."""
    words = advice.options.split()
    against = None
    if words:
        taken = argparse.Namespace(**vars(args) | {words[0][2:]: words[1] if len(words) > 1 else True})
        try:
            check_together(chosen(taken), taken, several=False)
        except UserError as error:
            against = str(error)
    if against:
        print(f"not recommended here: {advice.options} ({against})")
    names = tuple(word.partition("=")[0] for word in given if word.startswith("--") and word != "--")
    return advice._replace(options="") if against or advice.options.startswith(names) else advice


def check_options(source: str, images: str, model: str | None = None, masks: str = "") -> list[Finding]:
    """Notes of doctor.py on options that a scene asks for; none where it cannot be read.

    images, masks: as train.py's. model: folder of a model; what it was trained with is not asked for.
    """
    then = _read_trained_options(model) if model else []
    given = argparse.Namespace(source_path=source, images=images, masks=masks)
    dataset = ModelParams(argparse.ArgumentParser()).extract(given)
    dataset.lenses = "native"
    try:
        found = [*advise(dataset, trains=False)]
    except UserError:
        return []
    return [advice for advice in found if advice.options and advice.options.split()[0] not in then]


def _read_trained_options(model: str) -> list[str]:
    """Options that a training has switched on, as words of a command line; none where no model is."""
    try:
        return [f"--{name}" for name, value in read_training_options(model).items() if value not in _OFF]
    except UserError:
        return []


def _check_distances(scene: Scene, tracks: list[PhotoPoints | None]) -> Iterator[Finding]:
    """Advise by the tracks of structure from motion: options that pay where photos have unlike distances."""
    ratio = measure_distance_ratio(scene.info.train_cameras, tracks)
    text = f"the farthest photo of a point is {ratio:.1f} times as far away as the nearest (median)"
    yield note(text, "--antialiasing" if ratio > DISTANCES else "")


def measure_distance_ratio(views: list[CameraInfo], tracks: list[PhotoPoints | None]) -> float:
    """Return the largest over the smallest distance of a point from the photos that see it, the median over points.

    Distances are in focal lengths.
    """
    seen = [(track.ranks, np.linalg.norm(track.points @ view.R + view.T, axis=1) / view.fx)
            for view, track in zip(views, tracks, strict=True) if track is not None]  # fmt: skip
    points, away = map(np.concatenate, zip(*seen, strict=True))
    near, far = np.full(points.max() + 1, np.inf), np.zeros(points.max() + 1)
    np.minimum.at(near, points, away)
    np.maximum.at(far, points, away)
    shared = (np.bincount(points) > 1) & (near > 0)
    return float(np.median(far[shared] / near[shared])) if shared.any() else 1.0


def _list_data_words(dataset: argparse.Namespace) -> list[str]:
    """Words for train.py that choose and read the data as model options say: all but _NOT_OF_DATA."""
    words = []
    for option in ModelParams.options:
        value = getattr(dataset, option.name, option.default)
        if option.name not in _NOT_OF_DATA and value != option.default:
            words.append(f"--{option.name}" if value is True else f"--{option.name}={value}")
    return words


def _train(line: list[str]) -> None:
    """Run a training to its end, also where a signal interrupts it, and show how far it is.

    UserError with its last message if it fails.
    """
    said = ""
    with subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as child:
        try:
            for text in child.stderr:
                if "%|" in text:
                    print(text, end="", file=sys.stderr, flush=True)
                else:
                    said += text
        except BaseException:  # Popen itself leaves a child behind after Ctrl-C
            child.kill()
            child.wait()
            raise
    if child.returncode:
        raise UserError(said.strip().rpartition("\n")[2].removeprefix("error: ") or "the short training failed")


def _train_shortly(dataset: argparse.Namespace) -> Iterator[Finding]:
    """Train shortly on small photos, and advise by the errors that remain."""
    with tempfile.TemporaryDirectory() as folder:
        own = ["-m", folder, "-r", _WIDTH, "--iterations", _ITERATIONS, "--quiet", "--no_curve", "--disable_viewer"]
        own += ["--no_last_checkpoint"]
        print(f"{_ITERATIONS:,} iterations on photos of {_WIDTH} pixels show what the records do not", flush=True)
        _train([sys.executable, str(ROOT / "train.py"), *map(str, own), *_list_data_words(dataset)])
        scene, views = load_scored(folder)
        for part in PARTS:
            yield from part.advise_trained(scene, views)
