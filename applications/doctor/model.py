"""Checks of a trained model: its values, and its renders against the photos and against what training scored."""

import argparse
import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from applications.doctor.changes import FITS as BAD_PSNR
from applications.doctor.changes import LOST, find_changes, read_recorded_psnr
from arguments import ModelParams, PipelineParams, read_model_json, read_stored_options
from arguments.features import options_of
from gaussian_renderer.scored_views import ScoredViews
from groundwork.finding import Finding, fine, from_error
from scene import Scene
from scene.cameras import Camera
from scene.checks.scene import check_dataset
from scene.gaussian_model import GaussianModel
from scene.images.masks import AUTO, MaskOptions
from scene.images.sizes import training_size
from scene.readers.info import CameraInfo, photo_size
from scene.saved_model import load_saved
from splatting.checks import LATE_RESET, check_overfitting
from splatting.records.model_folder import closing_lines, curve_of
from splatting.records.training_log import NAME as LOG
from splatting.records.training_log import read_log
from splatting.registry import PARTS
from utils.image_utils import as_float, pixels_that_count, psnr
from utils.system_utils import UserError, compute_device

UNRECOVERED = 0.2  # median within 500 iterations of a reset
BLACK = 0.02  # mean of an image in [0, 1]
FEW_ITERATIONS = 3000
_VIEWS = 4
_WIDTH = 200  # pixels of a view, or fewer where it was trained smaller


def check_model(model_path: str, iteration: int, source: str | None = None, images: str | None = None) -> list[Finding]:
    """Check the model that train.py wrote into a folder.

    iteration: -1: the last one saved.
    source, images: scene folder and its folder of photos; None: those that the model was trained on.
    """
    try:
        own = read_stored_options(model_path)
        stored = own | ({"source_path": source} if source is not None else {})
        stored |= {"images": images} if images is not None else {}
        options, scene = _load(model_path, stored, iteration)
    except UserError as error:
        return [from_error(error)]
    gaussians, name = scene.gaussians, f"iteration {scene.loaded_iter}"
    if not len(gaussians):
        return [Finding(f"{name} has no Gaussians, so renders show the background", "train it again")]
    lines = [fine(f"{name}, {len(gaussians)} Gaussians of SH degree {gaussians.max_sh_degree}")]
    if wrong := [*_check_finite(gaussians)]:
        return [*lines, *wrong]
    lines.append(_check_shapes(scene))
    renders, changed = _compare_renders(scene, options, stored)
    if renders.is_problem and stored != own and _renders_well(model_path, own, scene.loaded_iter):
        other_scene = stored["source_path"] != own["source_path"]
        what, name, option = ("scene", "source_path", "-s") if other_scene else ("photos", "images", "-i")
        said = f"the model fits the {what} that it was trained on, but not {stored[name]}"
        renders = Finding(said, f"give {option} {own[name]}")
        changed = True
    if changed:  # which explains all else, and the training has no say in it
        return [*lines, renders]
    reset = [] if renders.is_problem else _check_late_reset(scene)
    odd = [] if renders.is_problem else _examine_parts(scene, options)
    return [*lines, renders, *odd, *reset, *check_training(Path(model_path))]


def _renders_well(model_path: str, stored: dict[str, Any], iteration: int) -> bool:
    """Tell if the model renders well the views of the scene that it was trained on."""
    try:
        options, scene = _load(model_path, stored, iteration)
    except UserError:
        return False
    return not _compare_renders(scene, options, stored)[0].is_problem


def check_training(model: Path) -> list[Finding]:
    """Find an overfitting in the log and the curve of the training, if it has written them."""
    try:
        return [*check_overfitting(curve_of(model), read_log(model / LOG))]
    except UserError as error:
        return [from_error(error)]


def _load(model_path: str, stored: dict[str, Any], iteration: int) -> tuple[argparse.Namespace, Scene]:
    """Load options and scene of a model, with views that are just large enough to tell black renders from bad ones.

    The views are no larger than in training: a model of small photos has no detail for larger ones, and looks broken
    there.
    """
    given = {**stored, "model_path": model_path, "resolution": _WIDTH, "images_to_load": 1}
    given |= {option.name: option.default for option in options_of("model") if not option.seen}
    options = ModelParams(argparse.ArgumentParser()).extract(argparse.Namespace(**given))
    with contextlib.redirect_stdout(io.StringIO()):  # from the readers
        scene = load_saved(options, iteration)
        trained = stored.get("resolution", -1)
        widths = [_find_trained_width(view, trained) for view in scene.info.train_cameras]
        if min(widths, default=_WIDTH) < _WIDTH:
            options.resolution = trained if max(widths) <= _WIDTH else min(widths)
            scene = load_saved(options, iteration)
        return options, scene


def _find_trained_width(view: CameraInfo, resolution: int) -> int:
    """Return the width (pixels) at which a photo trains with -r, exact below _WIDTH only: -1 limits wider ones."""
    size = photo_size(view)
    return size[0] if resolution == -1 else training_size(*size, resolution)[0]


def _check_finite(gaussians: GaussianModel) -> Iterator[Finding]:
    """Find NaN and infinities among the parameters."""
    shapes = gaussians.raw_geometry()
    raw = {
        "position": gaussians.get_xyz,
        "opacity": shapes["opacities"],
        "scale": shapes["scales"],
        "rotation": shapes["rotations"],
        "colour": gaussians.get_features,
    }
    for name, values in raw.items():
        if bad := int((~torch.isfinite(values)).flatten(1).any(dim=1).sum()):
            text = f"{bad} of {len(values)} Gaussians have a {name} that is not finite"
            yield Finding(text, "resume from an earlier checkpoint, or train again, with lower learning rates")


def _examine_parts(scene: Scene, options: argparse.Namespace) -> Iterator[Finding]:
    """Ask the parts of a training for notes on the trained model."""
    views = _make_scored_views(scene, options)
    for part in PARTS:
        yield from part.examine(scene, views)


def load_scored(model_path: str) -> tuple[Scene, ScoredViews]:
    """The newest model of a folder in its scene, and what scores its views."""
    options, scene = _load(model_path, read_stored_options(model_path), -1)
    return scene, _make_scored_views(scene, options)


def _check_late_reset(scene: Scene) -> Iterator[Finding]:
    """Repeat the warning about a late reset that training printed at its start, if the opacities have not recovered."""
    faint = float(scene.gaussians.get_opacity.detach().median()) < UNRECOVERED
    lines = closing_lines(Path(scene.model_path)) if faint else []
    said = [line.removeprefix("warning: ") for line in lines]
    yield from (from_error(UserError(text)) for text in said if text.startswith(LATE_RESET))


def _check_shapes(scene: Scene) -> Finding:
    opacities = scene.gaussians.get_opacity.detach()
    sizes = scene.gaussians.get_scaling.detach().max(dim=1).values / scene.cameras_extent
    said = f"opacities: median {opacities.median():.2f}; sizes: median {sizes.median():.2g}, largest {sizes.max():.2g}"
    return fine(f"{said} extents of the cameras")


def _compare_renders(scene: Scene, options: argparse.Namespace, stored: dict[str, Any]) -> tuple[Finding, bool]:
    """Compare a few small training views with their photos; return also whether these or the model have changed."""
    views = _choose_views(scene)
    means = _average_views(views, scene, options)
    if means is None:
        return Finding("no pixel of the inspected training views counts", "check --masks and --invert_masks"), False
    black = means.render < BLACK
    if black and means.photo < BLACK:
        return Finding("the photos themselves are black", "inspect them; if they are transparent, train with -w"), False
    then = read_recorded_psnr(Path(scene.model_path), scene.loaded_iter)
    good = not black and means.psnr >= max(BAD_PSNR, (then or 0.0) - LOST)
    changed = find_changes(scene, _make_scored_views(scene, options), means.psnr, then)
    if good and changed:  # a few other photos leave a good mean
        return changed, True
    if good:
        width = max(view.image_width for view in views)
        return fine(f"{len(views)} training views rendered {width} pixels wide: PSNR {means.psnr:.1f} dB"), False
    text = "renders of the training views are black"
    text = text if black else f"training views have a PSNR of only {means.psnr:.1f} dB"
    wrong = changed or next(_check_late_reset(scene), None) or Finding("", _suggest_remedy(scene, stored, black))
    return wrong._replace(text=f"{text}: {wrong.text}" if wrong.text else text), wrong is changed


class Means(NamedTuple):
    """Means over views of scored pixels: render, photo and PSNR (dB)."""

    render: float
    photo: float
    psnr: float


def _choose_views(scene: Scene) -> list[Camera]:
    cameras = [camera for camera in scene.getTrainCameras() if camera.columns is None]  # whole views
    return cameras[:: -(-len(cameras) // _VIEWS) or 1]


def _average_views(cameras: list[Camera], scene: Scene, options: argparse.Namespace) -> Means | None:
    """Means over the views of which some pixel counts (masks, half images); None if there are none."""
    measured = [values for camera in cameras if (values := _measure_view(camera, scene, options))]
    return Means(*(float(np.mean(values)) for values in zip(*measured, strict=True))) if measured else None


def _make_pipe(scene: Scene) -> argparse.Namespace:
    pipe = PipelineParams(argparse.ArgumentParser()).extract(argparse.Namespace())
    stored = read_model_json(scene.model_path)
    pipe.antialiasing, pipe.projection = stored.get("antialiasing", False), stored.get("projection", "ewa")
    return pipe


def _make_scored_views(scene: Scene, options: argparse.Namespace) -> ScoredViews:
    background = torch.full((3,), 1.0 if options.white_background else 0.0, device=compute_device())
    return ScoredViews(_make_pipe(scene), background, scene.halves)


@torch.no_grad()
def _measure_view(camera: Camera, scene: Scene, options: argparse.Namespace) -> tuple[float, ...] | None:
    """Return the `Means` of one view; None if no pixel of it counts."""
    image, target, mask = _make_scored_views(scene, options).compared(camera, scene.gaussians)
    if mask is not None and not mask.any():
        return None
    image, target = (pixels_that_count(x, mask) for x in (image, as_float(target)))
    return float(image.mean()), float(target.mean()), min(float(psnr(image, target).mean()), 99.0)


def _suggest_remedy(scene: Scene, stored: dict[str, Any], is_black: bool) -> str:
    """Say what to check where renders are bad and nothing has changed since the training."""
    if not is_black and scene.loaded_iter < FEW_ITERATIONS:
        return f"train longer, {FEW_ITERATIONS} iterations at least"
    masks = MaskOptions(stored.get("masks", ""), stored.get("invert_masks", False), stored.get("mask_meaning", AUTO))
    dataset = check_dataset(stored.get("source_path", ""), stored.get("images", "images"), masks)
    if problem := next((line for line in dataset if line.is_problem), None):
        return f"the dataset has problems ({problem.text}): {problem.remedy}"
    return "check the poses (x right, y down, z forward), and whether scene (-s) and photos are those of the model"
