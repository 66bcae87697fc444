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
from typing import NamedTuple

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.linalg import spsolve

from arguments import ModelParams, read_training_options
from scene.cameras import Camera
from scene.check import of_options, tell
from scene.gaussian_model import GaussianModel
from scene.readers.info import CameraInfo
from scene.readers.tracks import Track, read_tracks
from scene.scene import Scene
from splatting.diagnosis import Line
from splatting.diagnosis.model import load_scored
from splatting.distributed.ranks import ranks
from splatting.files.json_files import write_json
from splatting.parts import check_together, chosen, options_of, tools
from utils.image_utils import as_float
from utils.system_utils import UserError, mkdir_p

ADVICE = "advice.json"  # what train.py --advise writes: texts, and options that the scene asks for
EXPOSURES = 0.4  # stops; photos of a usual automatic exposure differ by 0.15 to 0.35
DISTANCES = 2.5  # the farthest photo of a point over the nearest
_AGAINST = {  # by an advised option: the options, with these values, that it does not go with, besides those of parts
    "--appearance": {"train_test_exp": True},
}
_OFF = (False, "", "none", "off")  # values of options that do nothing; 0 is equal to False
_NOT_OF_DATA = {  # model options that the short training of small photos has itself, or does without
    "sh_degree", "model_path", "resolution", "train_test_exp", "appearance",
} | {option.name for option in options_of("model")}  # fmt: skip
_WIDTH = 200  # pixels of a photo
_DARK, _LIGHT = 0.02, 0.98  # of a channel; beyond, an exposure cannot be told
_OUTLIER = 0.6  # stops; a larger difference is no exposure (Tukey's biweight: Beaton and Tukey 1974)
_ROUNDS = 10
_ITERATIONS = 1000  # of the short training
_LUMINANCE = (0.2126, 0.7152, 0.0722)  # of linear sRGB
ROOT = Path(__file__).resolve().parents[2]


class Advice(NamedTuple):
    """A number of a scene, and the options that it asks for; none, if it asks for nothing."""

    text: str
    options: str = ""

    def __str__(self) -> str:
        return f"{self.text}; try {self.options}" if self.options else self.text


def advise(dataset: argparse.Namespace, trains: bool = True, warns: bool = False) -> list[Advice]:
    """Advice on a scene. dataset: the model options. trains: ask by a short training, too.

    warns: print what the check of the scene finds, too. UserError as from Scene, and where the scene cannot be trained.
    """
    small = copy.copy(dataset)
    small.resolution, small.model_path = _WIDTH, ""
    vars(small).update({option.name: option.default for option in options_of("model")})
    with contextlib.redirect_stdout(io.StringIO()):  # from the readers
        scene = Scene(small, GaussianModel(0), shuffle=False, start=False)
    if trains:
        tell(of_options(scene.info, dataset), dataset.source_path, quiet=not warns)
    tracks = read_tracks(dataset.source_path, scene.info.train_cameras, scene.info.offset)
    found = [*_of_tracks(scene, tracks)] if any(tracks) else []
    found += [Advice(*one) for advise_part in tools("advise") for one in advise_part(scene, tracks)]
    return [*found, *_of_short_training(dataset)] if trains else found


def asked_options(dataset: argparse.Namespace, args: argparse.Namespace, given: Sequence[str]) -> list[str]:
    """Print the advice on a scene, and return the options that it asks for, as words of a command line.

    args: the options of the training, from the words `given`. Advice on one of these words, and advice that does not go
    with these options, is left out. With --advise their model folder gets ADVICE.
    """
    if ranks().several:
        raise UserError("--advise and --options auto need one process; run train.py --advise, and give what it says")
    if written := args.advise and dataset.model_path:
        mkdir_p(dataset.model_path)  # if it cannot be, better before the search
    found = advise(dataset, warns=args.advise)  # a training that follows prints them itself
    print(*found, sep="\n")
    found = [_taken(advice, args, given) for advice in found]
    if written:
        write_json(Path(dataset.model_path) / ADVICE, [advice._asdict() for advice in found])
    words = " ".join(advice.options for advice in found).split()
    print(f"options that this scene asks for, besides those given: {' '.join(words) or 'none'}")
    return words


def _taken(advice: Advice, args: argparse.Namespace, given: Sequence[str]) -> Advice:
    """The advice, without its options where one of them is given, or where they do not go with given ones."""
    words = advice.options.split()
    unfit = _AGAINST.get(words[0], {}) if words else {}
    against = next(
        (f"it does not go with --{name}" for name, value in unfit.items() if getattr(args, name) == value), None
    )
    if words and not against:
        taken = argparse.Namespace(**vars(args) | {words[0][2:]: words[1] if len(words) > 1 else True})
        try:
            check_together(chosen(taken), taken, several=False)
        except UserError as error:
            against = str(error)
    if against:
        print(f"{advice.options} is left out: {against}")
    names = tuple(word.partition("=")[0] for word in given if word.startswith("--") and word != "--")
    return advice._replace(options="") if against or advice.options.startswith(names) else advice


def check_options(source: str, images: str, model: str | None = None) -> list[Line]:
    """Notes of doctor.py on options that a scene asks for; none where it cannot be read.

    images: as train.py's -i. model: folder of a model; what it was trained with is not asked for.
    """
    then = _trained_with(model) if model else []
    dataset = ModelParams(argparse.ArgumentParser()).extract(argparse.Namespace(source_path=source, images=images))
    dataset.lenses = "native"
    try:
        found = advise(dataset, trains=False)
    except UserError:
        return []
    found = [advice for advice in found if advice.options and advice.options.split()[0] not in then]
    return [Line(str(advice), note=True) for advice in found]


def _trained_with(model: str) -> list[str]:
    """Options that a training has switched on, as words of a command line; none where no model is."""
    try:
        return [f"--{name}" for name, value in read_training_options(model).items() if value not in _OFF]
    except UserError:
        return []


def _of_tracks(scene: Scene, tracks: list[Track | None]) -> Iterator[Advice]:
    """What the tracks of structure from motion say."""
    views = scene.info.train_cameras
    cameras = sorted(scene.getTrainCameras(), key=lambda camera: camera.uid)
    spread = float(np.std(exposures(cameras, tracks)))
    yield _asked(f"exposures of the photos differ by {spread:.2f} stops", spread > EXPOSURES, "--appearance ppisp")
    ratio = distances(views, tracks)
    text = f"the farthest photo of a point is {ratio:.1f} times as far away as the nearest (median)"
    yield _asked(text, ratio > DISTANCES, "--antialiasing")


def _asked(text: str, asks: bool, options: str) -> Advice:
    return Advice(text, options if asks else "")


def exposures(cameras: list[Camera], tracks: list[Track | None]) -> np.ndarray:
    """Exposures (K,) in stops around their mean, of the photos that have a track.

    A robust fit: log2 of a luminance is the exposure of its photo and the albedo of its point.
    """
    logs, points, photos = [], [], []
    for track, camera in zip(tracks, cameras, strict=True):
        if track is None:
            continue
        image = as_float(camera.target(torch.zeros(3, device=camera.device))).cpu().numpy()
        column, row = (track.places * image.shape[:0:-1]).astype(int).T
        inside = (column >= 0) & (column < image.shape[2]) & (row >= 0) & (row < image.shape[1])
        colors = image[:, row[inside], column[inside]]
        usable = (colors.max(0) < _LIGHT) & (colors.min(0) > _DARK)
        logs.append(np.log2(np.tensordot(_LUMINANCE, _linear(colors[:, usable]), 1)))
        points.append(track.ranks[inside][usable])
        photos.append(np.full(len(points[-1]), len(photos)))
    log, point, photo = map(np.concatenate, (logs, points, photos))
    weight = np.ones(len(log))
    for _ in range(_ROUNDS):
        exposure, albedo = _fitted(log, weight, photo, point, len(logs))
        away = log - exposure[photo] - albedo[point]
        weight = np.maximum(1 - (away / _OUTLIER) ** 2, 1e-3) ** 2
    return exposure - exposure.mean()


def _fitted(
    values: np.ndarray, weight: np.ndarray, photo: np.ndarray, point: np.ndarray, photos: int
) -> tuple[np.ndarray, np.ndarray]:
    """Exposures (photos,) and albedos whose sums are nearest to values (K,), by weighted least squares.

    Albedos are eliminated (Triggs et al. 2000, section 6.1). To fit both by turns would take as many rounds as a walk
    has photos.
    """
    seen = sparse.coo_array((weight, (photo, point)), (photos, point.max(initial=0) + 1)).tocsr()
    of_point, of_photo = (np.maximum(seen.sum(axis), 1e-9) for axis in (0, 1))
    matrix = sparse.diags_array((1 + 1e-9) * of_photo) - seen / of_point @ seen.T  # singular else: their sum is free
    mean = np.bincount(point, weight * values) / of_point
    vector = np.bincount(photo, weight * (values - mean[point]), photos)
    exposure = spsolve(matrix.tocsc(), vector)
    return exposure, np.bincount(point, weight * (values - exposure[photo])) / of_point


def _linear(values: np.ndarray) -> np.ndarray:
    """sRGB to light (IEC 61966-2-1)."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def distances(views: list[CameraInfo], tracks: list[Track | None]) -> float:
    """The median over points of the largest over the smallest distance in focal lengths, of the photos that see it."""
    seen = [(track.ranks, np.linalg.norm(track.points @ view.R + view.T, axis=1) / view.fx)
            for view, track in zip(views, tracks, strict=True) if track is not None]  # fmt: skip
    points, away = map(np.concatenate, zip(*seen, strict=True))
    near, far = np.full(points.max() + 1, np.inf), np.zeros(points.max() + 1)
    np.minimum.at(near, points, away)
    np.maximum.at(far, points, away)
    shared = (np.bincount(points) > 1) & (near > 0)
    return float(np.median(far[shared] / near[shared])) if shared.any() else 1.0


def _data_words(dataset: argparse.Namespace) -> list[str]:
    """Words for train.py that choose and read the data as model options say: all but _NOT_OF_DATA."""
    words = []
    for option in ModelParams.options:
        value = getattr(dataset, option.name, option.default)
        if option.name not in _NOT_OF_DATA and value != option.default:
            words.append(f"--{option.name}" if value is True else f"--{option.name}={value}")
    return words


def _trained(line: list[str]) -> None:
    """Run a training to its end, also where a signal interrupts it. UserError with the last message if it fails."""
    with subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as child:
        try:
            said = child.communicate()[1]
        except BaseException:  # Popen itself leaves a child behind after Ctrl-C
            child.kill()
            child.wait()
            raise
    if child.returncode:
        raise UserError(said.strip().rpartition("\n")[2].removeprefix("error: ") or "the short training failed")


def _of_short_training(dataset: argparse.Namespace) -> Iterator[Advice]:
    """What a short training of small photos leaves over."""
    with tempfile.TemporaryDirectory() as folder:
        own = ["-m", folder, "-r", _WIDTH, "--iterations", _ITERATIONS, "--quiet", "--no_curve", "--disable_viewer"]
        _trained([sys.executable, str(ROOT / "train.py"), *map(str, own), *_data_words(dataset)])
        scene, views = load_scored(folder)
        yield from (Advice(*one) for advise_part in tools("advise_trained") for one in advise_part(scene, views))
