"""Checks of a trained model: its values, and the likeliest reason for black or bad renders."""

import argparse
import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from arguments import ModelParams, PipelineParams, read_model_json, read_stored_options
from gaussian_renderer import render
from gaussian_renderer.scored_views import ScoredViews
from scene import Scene
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.images.sizes import training_size
from scene.readers.info import NEAREST, CameraInfo, photo_size
from scene.saved_model import load_saved
from splatting.evaluation.model_folder import closing_lines, curve_of
from splatting.evaluation.training_log import NAME as LOG
from splatting.evaluation.training_log import read_log
from splatting.findings import Finding, fine, from_error
from splatting.findings.changes import FITS as BAD_PSNR
from splatting.findings.changes import LOST, of_scene, recorded_psnr, what_changed
from splatting.findings.scene import check_dataset
from splatting.findings.training import LATE_RESET, what_to_try
from splatting.registry import options_of, tools
from utils.image_utils import as_float, pixels_that_count, psnr
from utils.system_utils import UserError, compute_device

# Densification prunes below 0.005 and a reset leaves 0.01: a model of such a median has not recovered.
FAINT = 0.02
UNRECOVERED = 0.2  # median within 500 iterations of a reset
RESET = (0.005, 0.0101)  # opacities after a reset to at most 0.01, which is below float32's 0.01; less is pruned
RESET_SHARE = 0.95
SIZES = (1e-6, 1.0)  # extents: medians of trained models are 1e-4 to 0.1
SPREADS = (0.01, 100.0)  # extents: from an object amid far cameras to a landscape beyond near ones
BINS = (0.0, 0.01, 0.05, 0.2, 0.5, 0.9, 1.0)
HUGE = 1.0  # extents: one standard deviation of a splat as large as the whole scene
HUGE_SHARE = 0.01
BLACK = 0.02  # mean of an image in [0, 1]
FEW_ITERATIONS = 3000
BEGUN = 200  # iterations, from which on a model is better than one colour
RESET_INTERVAL = 3000  # the default of --opacity_reset_interval
FEW_GAUSSIANS = 2000
_VIEWS = 4
_WIDTH = 200  # pixels of a view, or fewer where it was trained smaller


def check_model(model_path: str, iteration: int, source: str | None = None, images: str | None = None) -> list[Finding]:
    """What to say of the model that train.py wrote into a folder; iteration -1: the last one saved.

    source, images: scene folder and its folder of photos, None: those that the model was trained on.
    """
    try:
        own = read_stored_options(model_path)
        stored = own | ({"source_path": source} if source is not None else {})
        stored |= {"images": images} if images is not None else {}
        options, scene = _load(model_path, stored, iteration)
    except UserError as error:
        return [from_error(error)]
    gaussians, extent = scene.gaussians, scene.cameras_extent
    name = f"iteration {scene.loaded_iter}"
    if not len(gaussians):
        return [Finding(f"{name} has no Gaussians, so renders show the background", "train it again")]
    lines = [fine(f"{name}, {len(gaussians)} Gaussians of SH degree {gaussians.max_sh_degree}")]
    own_rows = of_scene(scene)
    if wrong := [*_not_finite(gaussians)] or [*_wrong_sizes(own_rows, extent)]:
        return [*lines, *wrong]
    shapes, (renders, changed) = [_opacities(own_rows), _sizes(scene)], _renders(scene, options, stored)
    if renders.is_problem and stored != own and _fits(model_path, own, scene.loaded_iter):
        other_scene = stored["source_path"] != own["source_path"]
        what, name, option = ("scene", "source_path", "-s") if other_scene else ("photos", "images", "-i")
        said = f"the model fits the {what} that it was trained on, but not {stored[name]}"
        renders = Finding(said, f"give {option} {own[name]}")
        changed = True
    if changed:  # which explains all else, and the training has no say in it
        return [*lines, *(line for line in shapes if not line.is_problem), renders]
    reset = [] if renders.is_problem else _late_reset(scene)
    odd = [] if renders.is_problem else _notes(scene, options)
    return [*lines, *shapes, renders, *odd, *reset, *check_training(Path(model_path))]


def _fits(model_path: str, stored: dict[str, Any], iteration: int) -> bool:
    """Whether the model renders the views of the scene that it was trained on well."""
    try:
        options, scene = _load(model_path, stored, iteration)
    except UserError:
        return False
    return not _renders(scene, options, stored)[0].is_problem


def check_training(model: Path) -> list[Finding]:
    """Notes on what the log and the curve of the training suggest to try; none where it has written none."""
    try:
        return what_to_try(curve_of(model), read_log(model / LOG))
    except UserError as error:
        return [from_error(error)]


def _load(model_path: str, stored: dict[str, Any], iteration: int) -> tuple[argparse.Namespace, Scene]:
    """Options and scene of a model with small views, which are enough to tell black renders from bad ones.

    They are no larger than in training: a model of small photos has no detail for larger ones, and looks broken there.
    """
    given = {**stored, "model_path": model_path, "resolution": _WIDTH, "images_to_load": 1}
    given |= {option.name: option.default for option in options_of("model") if not option.seen}
    options = ModelParams(argparse.ArgumentParser()).extract(argparse.Namespace(**given))
    with contextlib.redirect_stdout(io.StringIO()):  # from the readers
        scene = load_saved(options, iteration)
        trained = stored.get("resolution", -1)
        widths = [_trained_width(view, trained) for view in scene.info.train_cameras]
        if min(widths, default=_WIDTH) < _WIDTH:
            options.resolution = trained if max(widths) <= _WIDTH else min(widths)
            scene = load_saved(options, iteration)
        return options, scene


def _trained_width(view: CameraInfo, resolution: int) -> int:
    """Width in pixels at which a photo trains with -r, as far as it may be below _WIDTH: -1 only limits wider ones."""
    size = photo_size(view)
    return size[0] if resolution == -1 else training_size(*size, resolution)[0]


def _not_finite(gaussians: GaussianModel) -> Iterator[Finding]:
    """NaN and infinities among the parameters."""
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


def _wrong_sizes(gaussians: GaussianModel, extent: float) -> Iterator[Finding]:
    """Sizes that are all far too small or too large for the cameras."""
    median = float(gaussians.get_scaling.detach().max(dim=1).values.median()) / extent
    low, high = SIZES
    if not low <= median <= high:
        text = f"the Gaussians are too {'small' if median < low else 'large'} for these cameras"
        remedy = "check what wrote or changed the PLY: scales are natural logarithms, in the units of the cameras"
        yield Finding(f"{text}: their median size is {median:.2g} extents", remedy)


def _wrong_values(gaussians: GaussianModel, extent: float) -> Iterator[Finding]:
    """Positions in other units than the cameras', and opacities as a reset leaves them, with no training after it."""
    points, opacity = gaussians.get_xyz.detach(), gaussians.get_opacity.detach()
    spread = float((points - points.median(dim=0).values).norm(dim=1).median()) / extent
    if not SPREADS[0] <= spread <= SPREADS[1]:
        remedy = (
            "check whether the model belongs to this dataset (-s), and what scaled the PLY: both need the same units"
        )
        yield Finding(f"the positions of the Gaussians spread over {spread:.2g} extents of the cameras", remedy)
    share = float(((opacity >= RESET[0]) & (opacity <= RESET[1])).float().mean())
    if share >= RESET_SHARE:
        text = f"{share:.0%} of the opacities are near 0.01, as a reset leaves them, and nothing was trained after it"
        remedy = "check an earlier iteration, or train some 1000 iterations beyond the reset (--opacity_reset_interval)"
        yield Finding(text, remedy)


def _notes(scene: Scene, options: argparse.Namespace) -> Iterator[Finding]:
    """What parts of a training say of a trained model."""
    for examine in tools("examine"):
        yield from examine(scene, _scored(scene, options))


def load_scored(model_path: str) -> tuple[Scene, ScoredViews]:
    """The newest model of a folder in its scene, and what scores its views."""
    options, scene = _load(model_path, read_stored_options(model_path), -1)
    return scene, _scored(scene, options)


def _late_reset(scene: Scene) -> Iterator[Finding]:
    """What training said at its start of a reset, if the opacities have not recovered from it."""
    faint = float(of_scene(scene).get_opacity.detach().median()) < UNRECOVERED
    lines = closing_lines(Path(scene.model_path)) if faint else []
    said = [line.removeprefix("warning: ") for line in lines]
    yield from (from_error(UserError(text)) for text in said if text.startswith(LATE_RESET))


def _opacities(gaussians: GaussianModel) -> Finding:
    opacity = gaussians.get_opacity.detach().flatten().cpu().numpy()
    parts = zip(BINS, BINS[1:], np.histogram(opacity, bins=BINS)[0] / len(opacity), strict=False)
    shares = ", ".join(f"{low:g}-{high:g} {share:.0%}" for low, high, share in parts)
    return fine(f"opacities: {shares}; median {np.median(opacity):.2f}")


def _sizes(scene: Scene) -> Finding:
    """Sizes against the extent of the cameras, but of what a part has put beside the scene."""
    extent = scene.cameras_extent
    largest = of_scene(scene).get_scaling.detach().max(dim=1).values.cpu().numpy()
    huge = float((largest > HUGE * extent).mean())
    if huge <= HUGE_SHARE:
        return fine(f"sizes: median {np.median(largest) / extent:.2g}, largest {largest.max() / extent:.2g} extents")
    text = f"{huge:.1%} of the Gaussians are larger than the extent of the cameras ({extent:.3g})"
    return Finding(text, "remove far points from the start cloud, and check the poses")


def _renders(scene: Scene, options: argparse.Namespace, stored: dict[str, Any]) -> tuple[Finding, bool]:
    """What to say of a few training views, rendered small: close to their photos, or else the likeliest reason.

    And whether that is a change since the training.
    """
    views = _looked_at(scene)
    means = _means(views, scene, options)
    if means is None:
        return Finding("no pixel of the inspected training views counts", "check --masks and --invert_masks"), False
    black = means.render < BLACK
    if black and means.photo < BLACK:
        return Finding("the photos themselves are black", "inspect them; if they are transparent, train with -w"), False
    then = recorded_psnr(Path(scene.model_path), scene.loaded_iter)
    good = not black and means.psnr >= max(BAD_PSNR, (then or 0.0) - LOST)
    changed = what_changed(scene, _scored(scene, options), means.psnr, then)
    if good and changed:  # a few other photos leave a good mean
        return changed, True
    if good:
        width = max(view.image_width for view in views)
        return fine(f"{len(views)} training views rendered {width} pixels wide: PSNR {means.psnr:.1f} dB"), False
    text = "renders of the training views are black"
    text = text if black else f"training views have a PSNR of only {means.psnr:.1f} dB"
    wrong = changed or next(_wrong_values(of_scene(scene), scene.cameras_extent), None)
    wrong = wrong or next(_late_reset(scene), None)
    wrong = wrong or (_why_black(scene, views, means) if black else Finding("", _why_bad(scene, stored, means)))
    return wrong._replace(text=f"{text}: {wrong.text}" if wrong.text else text), wrong is changed


class Means(NamedTuple):
    """Means over views: render, photo and PSNR (dB) of scored pixels; shares of covered pixels and drawn Gaussians.

    plain: the PSNR of an image that has the photo's mean colour everywhere.
    """

    render: float
    photo: float
    coverage: float
    drawn: float
    psnr: float
    plain: float


def _looked_at(scene: Scene) -> list[Camera]:
    cameras = [camera for camera in scene.getTrainCameras() if camera.columns is None]  # whole views
    return cameras[:: -(-len(cameras) // _VIEWS) or 1]


def _means(cameras: list[Camera], scene: Scene, options: argparse.Namespace) -> Means | None:
    """Means over the views of which some pixel counts (masks, half images); None if there are none."""
    measured = [values for camera in cameras if (values := _measure(camera, scene, options))]
    return Means(*(float(np.mean(values)) for values in zip(*measured, strict=True))) if measured else None


def _pipe(scene: Scene) -> argparse.Namespace:
    pipe = PipelineParams(argparse.ArgumentParser()).extract(argparse.Namespace())
    stored = read_model_json(scene.model_path)
    pipe.antialiasing, pipe.projection = stored.get("antialiasing", False), stored.get("projection", "ewa")
    return pipe


def _scored(scene: Scene, options: argparse.Namespace) -> ScoredViews:
    background = torch.full((3,), 1.0 if options.white_background else 0.0, device=compute_device())
    return ScoredViews(_pipe(scene), background, scene.halves)


def _measure(camera: Camera, scene: Scene, options: argparse.Namespace) -> tuple[float, ...] | None:
    """Return the `Means` of one view; None if no pixel of it counts."""
    gaussians, pipe, views = scene.gaussians, _pipe(scene), _scored(scene, options)
    with torch.no_grad():
        image, target, mask = views.compared(camera, gaussians)
        if mask is not None and not mask.any():
            return None
        image, target = (pixels_that_count(x, mask) for x in (image, as_float(target)))
        black = torch.zeros_like(gaussians.get_xyz)
        white = black.new_ones(3)
        silhouette = render(camera, gaussians, pipe, white, override_color=black, want_depth=False)
    mean = target.flatten(1).mean(dim=1).view(-1, *[1] * (target.dim() - 1))
    ratios = (min(float(psnr(x, target).mean()), 99.0) for x in (image, mean.expand_as(target)))
    drawn = float((silhouette["radii"] > 0).float().mean())
    return float(image.mean()), float(target.mean()), 1 - float(silhouette["render"].mean()), drawn, *ratios


def _why_black(scene: Scene, cameras: list[Camera], means: Means) -> Finding:
    gaussians = of_scene(scene)
    if means.drawn < 0.01:
        depths = torch.cat([_depths(camera, gaussians.get_xyz) for camera in cameras])
        nearest = NEAREST / gaussians.enlargement
        if float(((depths > 0) & (depths < nearest)).float().mean()) > 0.5:
            text = f"most Gaussians are nearer than {nearest:g} and never drawn"
            return Finding(text, "scale cameras and points of the scene by 10 or more and train again")
        remedy = "check the poses (x right, y down, z forward) and whether the model belongs to this dataset"
        return Finding("no Gaussian is in view, because the cameras face away", remedy)
    if means.coverage < 0.1 or float(gaussians.get_opacity.detach().median()) < FAINT:
        remedy = "check the poses, and lower --opacity_lr; in a PLY of another program opacities must be logits"
        return Finding("the Gaussians are almost transparent", remedy)
    remedy = "check whether the training photos are black (transparent ones need -w), and check --feature_lr"
    return Finding("the Gaussians themselves are black", remedy)


def _depths(camera: Camera, points: torch.Tensor) -> torch.Tensor:
    return points @ camera.world_view_transform[:3, 2] + camera.world_view_transform[3, 2]


def _why_bad(scene: Scene, stored: dict[str, Any], means: Means) -> str:
    iteration = scene.loaded_iter
    faint = float(of_scene(scene).get_opacity.detach().median()) < UNRECOVERED
    if faint and RESET_INTERVAL <= iteration < 15_000 and iteration % RESET_INTERVAL < 500:
        return "this iteration is shortly after opacities were reset; check a later one"
    if (sizes := _sizes(scene)).is_problem:
        return sizes.remedy
    if means.psnr < means.plain and iteration >= BEGUN:
        return (
            "check the model's colours, the poses, the background and the scene (-s): the model does not fit these "
            f"photos, as an image of a photo's mean colour has {means.plain:.1f} dB"
        )
    if iteration < FEW_ITERATIONS:
        return f"train longer, {FEW_ITERATIONS} iterations at least"
    dataset = check_dataset(stored.get("source_path", ""), stored.get("images", "images"))
    if problem := next((line for line in dataset if line.is_problem), None):
        return f"the dataset has problems ({problem.text}): {problem.remedy}"
    if len(scene.gaussians) < FEW_GAUSSIANS:
        return f"there are only {len(scene.gaussians)} Gaussians; lower --densify_grad_threshold, or give more points"
    return "train with the default learning rates; if that does not help, the poses are wrong: reconstruct the scene"
