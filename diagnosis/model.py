"""Checks of a trained model: its values, and the likeliest reason for black or bad renders."""

import argparse
import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np
import torch

from arguments import ModelParams, PipelineParams, read_model_json, read_stored_options
from diagnosis.dataset import check_dataset
from diagnosis.lines import Line, from_error
from diagnosis.values import only_reset, wrong_positions, wrong_sizes
from gaussian_renderer import render
from gaussian_renderer.scored_views import ScoredViews
from records.error_curve import NAME as CURVE
from records.error_curve import read_curve
from records.training_log import NAME as LOG
from records.training_log import read_log
from records.what_to_try import what_to_try
from scene import Scene
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.saved_model import load_saved
from utils.image_utils import as_float, pixels_that_count, psnr
from utils.system_utils import UserError, compute_device

# Densification prunes below 0.005 and a reset leaves 0.01: a model of such a median has not recovered.
FAINT = 0.02
UNRECOVERED = 0.2  # median within 500 iterations of a reset
BINS = (0.0, 0.01, 0.05, 0.2, 0.5, 0.9, 1.0)
HUGE = 1.0  # extents: one standard deviation of a splat as large as the whole scene
HUGE_SHARE = 0.01
BLACK = 0.02  # mean of an image in [0, 1]
BAD_PSNR = 18.0  # dB on training views; models that converge reach 22 and more
FEW_ITERATIONS = 3000
RESET_INTERVAL = 3000  # the default of --opacity_reset_interval
NEAREST = 0.2  # depth below which nothing is drawn
FEW_GAUSSIANS = 2000
_CLEARLY = 3.0  # dB
_VIEWS = 4
_WIDTH = 200


def check_model(model_path: str, iteration: int, source: str | None = None, images: str | None = None) -> list[Line]:
    """Lines about the model that train.py wrote into a folder; iteration -1: the last one saved.

    source, images: scene folder and its folder of photos, None: those that the model was trained on.
    """
    try:
        stored = read_stored_options(model_path)
        stored |= {"source_path": source} if source is not None else {}
        stored |= {"images": images} if images is not None else {}
        options, scene = _load(model_path, stored, iteration)
    except UserError as error:
        return [from_error(error)]
    gaussians = scene.gaussians
    name = f"iteration {scene.loaded_iter}"
    if not len(gaussians):
        return [Line(f"{name} has no Gaussians, so renders show the background", "train it again")]
    degree = gaussians.max_sh_degree
    lines = [Line(f"{name}, {len(gaussians)} Gaussians of SH degree {degree}"), *check_values(gaussians)]
    if any(line.finding for line in lines):
        return lines
    if wrong := wrong_sizes(gaussians, scene.cameras_extent):
        return [*lines, wrong]
    lines += check_shapes(gaussians, scene.cameras_extent) + check_renders(scene, options, stored)
    return lines + check_training(Path(model_path))


def check_training(model: Path) -> list[Line]:
    """Notes on what the log and the curve of the training suggest to try; none where it has written none."""
    try:
        rows = read_curve(model / CURVE) if (model / CURVE).is_file() else []
        records = read_log(model / LOG)
    except UserError as error:
        return [from_error(error)]
    return [Line(sentence, note=True) for sentence in what_to_try(rows, records)]


def _load(model_path: str, stored: dict[str, Any], iteration: int) -> tuple[argparse.Namespace, Scene]:
    # Small images are enough to tell black renders from bad ones.
    given = {**stored, "model_path": model_path, "resolution": _WIDTH, "images_to_load": 1}
    given.pop("depths", None)
    options = ModelParams(argparse.ArgumentParser()).extract(argparse.Namespace(**given))
    with contextlib.redirect_stdout(io.StringIO()):  # from the readers
        return options, load_saved(options, iteration)


def check_values(gaussians: GaussianModel) -> list[Line]:
    """NaN and infinities among the parameters."""
    shapes = gaussians.raw_geometry()
    raw = {
        "position": gaussians.get_xyz,
        "opacity": shapes["opacities"],
        "scale": shapes["scales"],
        "rotation": shapes["rotations"],
        "colour": gaussians.get_features,
    }
    lines = []
    for name, values in raw.items():
        bad = int((~torch.isfinite(values)).flatten(1).any(dim=1).sum())
        if bad:
            lines.append(
                Line(
                    f"{bad} of {len(values)} Gaussians have a {name} that is not finite",
                    "resume from an earlier checkpoint, or train again, with lower learning rates",
                )
            )
    return lines


def check_shapes(gaussians: GaussianModel, extent: float) -> list[Line]:
    """Histogram of the opacities, and sizes against the extent of the cameras."""
    opacity = gaussians.get_opacity.detach().flatten().cpu().numpy()
    counts, _ = np.histogram(opacity, bins=BINS)
    shares = ", ".join(
        f"{low:g}-{high:g} {count / len(opacity):.0%}" for low, high, count in zip(BINS, BINS[1:], counts, strict=False)
    )
    lines = [Line(f"opacities: {shares}; median {np.median(opacity):.2f}")]
    largest = gaussians.get_scaling.detach().max(dim=1).values.cpu().numpy()
    huge = float((largest > HUGE * extent).mean())
    if huge > HUGE_SHARE:
        lines.append(
            Line(
                f"{huge:.1%} of the Gaussians are larger than the extent of the cameras ({extent:.3g})",
                "remove far points from the start cloud, and check the poses",
            )
        )
    else:
        lines.append(
            Line(f"sizes: median {np.median(largest) / extent:.2g}, largest {largest.max() / extent:.2g} extents")
        )
    return lines


def check_renders(scene: Scene, options: argparse.Namespace, stored: dict[str, Any]) -> list[Line]:
    """Line about a few training views, rendered small: close to their photos, or else the likeliest reason."""
    views = _looked_at(scene)
    means = _means(views, scene, options)
    if means is None:
        return [Line("no pixel of the inspected training views counts", "check --masks and --invert_masks")]
    brightness, truth, coverage, drawn, score = means
    if brightness < BLACK and truth < BLACK:
        return [Line("the photos themselves are black", "inspect them; if they are transparent, train with -w")]
    if brightness >= BLACK and score >= BAD_PSNR:
        return [Line(f"{len(views)} training views rendered {_WIDTH} pixels wide: PSNR {score:.1f} dB")]
    black = brightness < BLACK
    text = "renders of the training views are black" if black else f"training views have a PSNR of only {score:.1f} dB"
    if wrong := _wrong_values(scene) or _other_background(scene, options, stored, score):
        return [wrong._replace(text=f"{text}: {wrong.text}")]
    return [_why_black(scene, views, coverage, drawn) if black else Line(text, _why_bad(scene, stored))]


def _looked_at(scene: Scene) -> list[Camera]:
    cameras = [camera for camera in scene.getTrainCameras() if camera.columns is None]  # whole views
    return cameras[:: max(1, len(cameras) // _VIEWS)][:_VIEWS]


def _means(cameras: list[Camera], scene: Scene, options: argparse.Namespace) -> tuple[float, ...] | None:
    """Means of `_measure` over the views of which some pixel counts; None if there are none."""
    measured = [values for camera in cameras if (values := _measure(camera, scene, options))]
    return tuple(float(np.mean(values)) for values in zip(*measured, strict=True)) if measured else None


def _wrong_values(scene: Scene) -> Line | None:
    return wrong_positions(scene.gaussians, scene.cameras_extent) or only_reset(scene.gaussians)


def _other_background(scene: Scene, options: argparse.Namespace, stored: dict[str, Any], score: float) -> Line | None:
    """Line if photos and renders agree over the other background, black or white; None if not."""
    white = not options.white_background
    other_options, other = _load(scene.model_path, stored | {"white_background": white}, scene.loaded_iter)
    means = _means(_looked_at(other), other, other_options)
    if means is None or means[-1] < max(BAD_PSNR, score + _CLEARLY):
        return None
    name = "white" if white else "black"
    return Line(
        f"over {name} it is {means[-1]:.1f} dB",
        f"the model was trained on {name}: set white_background={white} in {scene.model_path}/cfg_args"
        + ("" if white else ", and render without -w"),
    )


def _measure(
    camera: Camera, scene: Scene, options: argparse.Namespace
) -> tuple[float, float, float, float, float] | None:
    """Means of render and photo, share of the image that is covered, share of Gaussians drawn, PSNR in dB.

    Means and PSNR are of the scored pixels (masks, half images); None if there are none.
    """
    gaussians = scene.gaussians
    pipe = PipelineParams(argparse.ArgumentParser()).extract(argparse.Namespace())
    pipe.antialiasing = read_model_json(scene.model_path).get("antialiasing", False)
    background = torch.full((3,), 1.0 if options.white_background else 0.0, device=compute_device())
    views = ScoredViews(pipe, background, options.train_test_exp)
    mask = views.mask(camera)
    if mask is not None and not mask.any():
        return None
    with torch.no_grad():
        image, target = (
            pixels_that_count(x, mask) for x in (views.image(camera, gaussians), as_float(views.target(camera)))
        )
        black = torch.zeros_like(gaussians.get_xyz)
        silhouette = render(
            camera, gaussians, pipe, torch.ones_like(background), override_color=black, want_depth=False
        )
    ratio = min(float(psnr(image, target).mean()), 99.0)
    drawn = float((silhouette["radii"] > 0).float().mean())
    return float(image.mean()), float(target.mean()), 1 - float(silhouette["render"].mean()), drawn, ratio


def _why_black(scene: Scene, cameras: list[Camera], coverage: float, drawn: float) -> Line:
    gaussians = scene.gaussians
    text = "renders of the training views are black: "
    if drawn < 0.01:
        depths = torch.cat([_depths(camera, gaussians.get_xyz) for camera in cameras])
        near = float(((depths > 0) & (depths < NEAREST)).float().mean())
        if near > 0.5:
            return Line(
                f"{text}most Gaussians are nearer than {NEAREST} and never drawn",
                "scale cameras and points of the scene by 10 or more and train again",
            )
        return Line(
            f"{text}no Gaussian is in view, because the cameras face away",
            "check the poses (x right, y down, z forward) and whether the model belongs to this dataset",
        )
    if coverage < 0.1 or float(gaussians.get_opacity.detach().median()) < FAINT:
        return Line(
            f"{text}the Gaussians are almost transparent",
            "check the poses, and lower --opacity_lr; in a PLY of another program opacities must be logits",
        )
    return Line(
        f"{text}the Gaussians themselves are black",
        "check whether the training photos are black (transparent ones need -w), and check --feature_lr",
    )


def _depths(camera: Camera, points: torch.Tensor) -> torch.Tensor:
    return points @ camera.world_view_transform[:3, 2] + camera.world_view_transform[3, 2]


def _why_bad(scene: Scene, stored: dict[str, Any]) -> str:
    iteration = scene.loaded_iter
    faint = float(scene.gaussians.get_opacity.detach().median()) < UNRECOVERED
    if faint and RESET_INTERVAL <= iteration < 15_000 and iteration % RESET_INTERVAL < 500:
        return "this iteration is shortly after opacities were reset; check a later one"
    if wrong := [line for line in check_shapes(scene.gaussians, scene.cameras_extent) if line.finding]:
        return wrong[0].remedy
    if iteration < FEW_ITERATIONS:
        return f"train longer, {FEW_ITERATIONS} iterations at least"
    problems = [
        line for line in check_dataset(stored.get("source_path", ""), stored.get("images", "images")) if line.finding
    ]
    if problems:
        return f"the dataset has problems ({problems[0].text}): {problems[0].remedy}"
    if len(scene.gaussians) < FEW_GAUSSIANS:
        return f"there are only {len(scene.gaussians)} Gaussians; lower --densify_grad_threshold, or give more points"
    return "train with the default learning rates; if that does not help, the poses are wrong: reconstruct the scene"
