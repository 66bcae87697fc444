"""Rehearsal of full_eval.py: what its runs would be, and whether they would find what they need."""

import argparse
import contextlib
import io
from collections.abc import Callable, Sequence

from scene.gaussian_model import GaussianModel
from scene.scene import Scene
from splatting.evaluation import stages
from splatting.evaluation.plan import Run
from splatting.files.listing import markdown_table
from utils.system_utils import UserError

Parse = Callable[[Sequence[str]], tuple[argparse.Namespace, ...]]


def rehearse(runs: Sequence[Run], parse: Parse, trains: bool = True) -> None:
    """Print what each run would be, and what is left to do for it.

    parse: train.py's parser. trains: False if existing models are rendered and scored. UserError for a scene or an
    option that would fail.
    """
    rows, photos = [], {}
    for run in runs:
        dataset = parse([*run.options, "-s", str(run.scene.source or "")])[1]
        key = str(vars(dataset))
        photos[key] = photos.get(key) or _photos(dataset, run)
        seed = "-" if run.seed is None else str(run.seed)
        end = "-" if not trains else f"{run.iterations:,}" if run.iterations else "by itself"
        rows.append([run.scene.name, run.config or "-", seed, *photos[key], end, stages.state(run, trains)])
    print(markdown_table(["scene", "options", "seed", "photos: train, test", "size", "iterations", "state"], rows))


def _photos(dataset: argparse.Namespace, run: Run) -> tuple[str, str]:
    """Numbers of photos and their sizes in training, found as training finds them. UserError as from Scene."""
    if run.scene.source is None:
        return "-", "-"
    if dataset.lenses == "auto":
        dataset.lenses = "native"
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # from the readers
            scene = Scene(dataset, GaussianModel(0), shuffle=False, start=False)
    except UserError as error:
        raise UserError(f"{run.title}: {error}") from error
    train, test = scene.getTrainCameras(), scene.getTestCameras()
    if not test:
        raise UserError(f"{run.title}: the scene has no test views, so there is nothing to score; add test photos")
    sizes = sorted({(camera.image_width, camera.image_height) for camera in (*train, *test)})
    many = f" and {len(sizes) - 1} more" if len(sizes) > 1 else ""
    return f"{len(train)}, {len(test)}", f"{sizes[-1][0]}x{sizes[-1][1]}{many}"
