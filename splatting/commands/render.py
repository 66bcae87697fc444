"""Render a trained model's train and test views as PNG beside the ground truth, and time the renders.

python render.py -m MODEL [--iteration N] [--skip_train] [--skip_test] [--depth] [--alpha]
python render.py -m MODEL --path {interpolate,ellipse,spiral,FILE.json} [--fps N] [--size W H] [--seconds S] [--frames]
python render.py -m MODEL --path top [--size W H]
python render.py -s SCENE -m OUT --ply FILE

Writes MODEL/{train,test}/ours_N/{renders,gt}/00000.png ..., numbered by the views' sorted order, masks/ for views of
which not every pixel counts, and render_times.json beside these folders: the time of each view without I/O. The device
is idle before the clock starts, and done when it stops. --depth and --alpha write inverse depth and alpha into folders
of these names, 16-bit PNGs with their scale in a text chunk (groundwork/files/image_files.py). Of COLMAP scenes,
--depth also writes depth_errors.json, the errors at points that no training was supervised by, for metrics.py.

With --path, writes MODEL/videos/ours_N/NAME.mp4 instead (gaussian_renderer/camera_paths/render_path.py), or top.png.
"""

from __future__ import annotations

import argparse
import copy
import shutil
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import partial
from pathlib import Path

import groundwork.host.openmp  # noqa: F401  isort: skip  (before torch)
import numpy as np
import torch

from arguments import ModelParams, OptionParser, PipelineParams, get_combined_args, read_cfg_args, warn_of_background
from gaussian_renderer.blending import PLANES, view_planes
from gaussian_renderer.camera_paths.render_path import add_path_options, path_request, render_path
from gaussian_renderer.camera_paths.without_scene import WithoutScene, saved_scene, warn_if_moved
from gaussian_renderer.memory_errors import explain_memory_errors
from gaussian_renderer.rays import check_views
from gaussian_renderer.scored_views import ScoredViews, extra_test_views
from groundwork.files.image_files import (
    open_image,
    pictures_at_once,
    remove_leftovers,
    to_bytes,
    write_plane,
    write_png,
)
from groundwork.files.json_files import write_json
from groundwork.host.progress import Bar, in_threads
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from scene.images.store import ImageStore, Picture
from scene.point_depths import PointDepths, held_out_points
from scene.saved_model import load_saved
from scene.scene import Scene
from scene.with_splats import load_file
from splatting.records.renders import BESIDE, DEPTHS, ERRORS, INCOMPLETE, TIMES, model_digest, summarise_times
from utils.general_utils import safe_state
from utils.system_utils import UserError, compute_device, mkdir_p

_COMPARED, _FEWEST, _SMALL = 24, 6, (32, 32)  # most and fewest views that are compared, and their size in pixels
_BETTER, _FITTING = 0.9, 0.75  # shares: of other photos that are less like a render than its own, and of such renders


def write_views(
    folder: Path,
    views: list[Camera],
    gaussians: GaussianModel,
    pipe: argparse.Namespace,
    background: torch.Tensor,
    train_test_exp: bool = False,
    planes: Collection[str] = (),
    points: Mapping[str, PointDepths] | None = None,
    scored: ScoredViews | None = None,
) -> list[float]:
    """Write renders, ground truth and masks of `views` under `folder`. Return the seconds per view, without I/O.

    train_test_exp: render with exposures, and write right halves only.
    planes: those of PLANES to write, too.
    points: score the depth at these points, by image name.
    scored: renderer and scorer of the views; None: by the options.
    """
    scored = scored or ScoredViews(pipe, background, train_test_exp)
    for side in ("renders", "gt"):
        if views:
            mkdir_p(folder / side)
            (folder / INCOMPLETE).touch()
        remove_leftovers(folder / side, len(views))
    remove_leftovers(folder / "masks", 0)  # some views may have none
    shutil.rmtree(folder / ERRORS, ignore_errors=True)
    for plane in PLANES:
        remove_leftovers(folder / plane, len(views) if plane in planes else 0)
    seconds, errors = [], {}
    for view in {(view.image_width, view.image_height): view for view in views}.values():
        # The first call of a size also pays for allocations and caches.
        scored.whole(view, gaussians)
    # All cores read the photos of a batch, then its views are drawn, which nothing disturbs, then all cores write.
    with Bar(total=len(views), desc=f"Rendering {folder.parent.name}", unit="view", disable=not views) as bar:
        for batch in _split_batches(views):
            files = _prepare_truths(folder, batch, scored, bar.n)
            for index, view in enumerate(batch, bar.n):
                _wait(background.device)
                start = time.perf_counter()
                image = scored.whole(view, gaussians)
                _wait(background.device)
                seconds.append(time.perf_counter() - start)
                name = f"{index:05d}.png"
                files.append(partial(write_png, to_bytes(scored.part(image)).numpy(), folder / "renders" / name))
                for plane, values in view_planes(view, gaussians, pipe).items() if planes else ():
                    if plane in planes:
                        shown = scored.part(values)[0].cpu().numpy()
                        files.append(partial(write_plane, folder / plane / name, shown, PLANES[plane].white))
                    if plane == "depth" and points and view.image_name in points:
                        errors[name] = points[view.image_name].scores(values, view.counted_pixels)
            in_threads(partial.__call__, files, disable=True)
            bar.update(len(batch))
    if errors:
        write_json(folder / DEPTHS, errors)
    (folder / INCOMPLETE).unlink(missing_ok=True)
    return seconds


def _split_batches(views: list[Camera]) -> Iterator[list[Camera]]:
    """Split views into batches, each of which is read, drawn and written at once."""
    size = pictures_at_once(max((view.image_width * view.image_height for view in views), default=0))
    return (views[start : start + size] for start in range(0, len(views), size))


def _prepare_truths(folder: Path, views: list[Camera], scored: ScoredViews, first: int) -> list[partial[None]]:
    """Read the photos of views, and return the calls that write truth and masks. first: number of the first view."""
    waiting: dict[ImageStore, list[Picture]] = {}  # views of a scene have one store, others one each
    for view in views:
        if pictures := getattr(view, "undecoded", None):
            waiting.setdefault(view.images, []).extend(pictures)
    for store, pictures in waiting.items():
        store.limit = store.limit and max(store.limit, len(pictures))
        store.prefetch(pictures)
    files = []
    for index, view in enumerate(views, first):
        name = f"{index:05d}.png"
        files.append(partial(write_png, to_bytes(scored.target(view)).numpy(), folder / "gt" / name))
        if (mask := scored.mask(view)) is not None:  # white where pixels count
            white = mask[0].to(torch.uint8).mul(255).cpu().numpy()
            files.append(partial(write_png, white, folder / "masks" / name))
    return files


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


@torch.no_grad()
def render_set(
    model_path: str | Path,
    name: str,
    iteration: int,
    views: list[Camera],
    gaussians: GaussianModel,
    pipeline: argparse.Namespace,
    background: torch.Tensor,
    train_test_exp: bool = False,
    separate_sh: bool = False,
    *,
    planes: Collection[str] = (),
    points: Mapping[str, PointDepths] | None = None,
    scored: ScoredViews | None = None,
    lacking: str = "",
) -> None:
    """Write renders, ground truth, masks and times of `views` under model_path/name/ours_ITERATION; print the time.

    train_test_exp: render with exposures, and write right halves only.
    separate_sh: accepted for callers of the reference; the SH bands are always passed separately.
    planes, points, scored: as for `write_views`.
    lacking: why there may be no views.
    """
    folder = Path(model_path) / name / f"ours_{iteration}"
    for of_earlier in (TIMES, DEPTHS):  # of an interrupted run they do not count
        (folder / of_earlier).unlink(missing_ok=True)
    with explain_memory_errors(gaussians, views):
        seconds = write_views(folder, views, gaussians, pipeline, background, train_test_exp, planes, points, scored)
    if not seconds:
        print(f"{name}: no views" + (f"; {lacking}" if lacking else ""))
        return
    sizes = [(view.image_width, view.image_height) for view in views]
    antialiasing = getattr(pipeline, "antialiasing", False)  # options of 2023 lack it
    times = summarise_times(seconds, sizes, len(gaussians), antialiasing, background.device)
    times["model_sha256"] = model_digest(Path(model_path), str(iteration))
    write_json(folder / TIMES, times)
    median = f"median {times['median_ms']:.2f} ms a view ({times['fps']:.1f} frames per second)"
    print(f"{name}: {len(views)} views, {median}")


@torch.no_grad()
def render_sets(
    dataset: argparse.Namespace,
    iteration: int,
    pipeline: argparse.Namespace,
    skip_train: bool,
    skip_test: bool,
    separate_sh: bool = False,
    *,
    sh_degree: int | None = None,
    planes: Collection[str] = (),
    ply: str = "",
) -> None:
    """Render the views of a saved iteration by `render_set`; -1: the last one.

    Folders of pictures that options draw or compare otherwise than the model's have names that say so, as in
    ours_30000_r2. Test views are also rendered as parts score them in addition, as ours_N_fitted_appearance. UserError
    if nothing can be loaded.

    dataset: the model options.
    sh_degree: degree that the PLY must have, None: any.
    planes: those of PLANES to write, too.
    ply: model of any tool to render instead, into folders that have its name.
    """
    scene, background = _load_scene(dataset, iteration, sh_degree, ply, pipeline)
    drawn = scene.gaussians, pipeline, background, scene.halves, separate_sh
    points = held_out_points(scene, dataset.source_path) if "depth" in planes and not skip_test else None
    if not skip_train:
        render_set(scene.model_path, "train", scene.loaded_iter, scene.getTrainCameras(), *drawn, planes=planes)
    if not skip_test:
        views, lacking = scene.getTestCameras(), ""
        if not dataset.eval:
            lacking = "--eval holds some out" if ply else "the model was trained without --eval"
        more = {"planes": planes, "points": points, "lacking": lacking}
        render_set(scene.model_path, "test", scene.loaded_iter, views, *drawn, **more)
        beside = extra_test_views(scene, pipeline, background)
        for name in BESIDE:
            scored, shown = beside.get(name, (None, []))
            method = f"{scene.loaded_iter}_{name}"
            if shown:
                render_set(scene.model_path, "test", method, shown, *drawn, planes=planes, scored=scored)
            else:
                shutil.rmtree(Path(scene.model_path) / "test" / f"ours_{method}", ignore_errors=True)
    if ply and not (skip_train and skip_test):
        folder = Path(scene.model_path) / ("test" if skip_train else "train") / f"ours_{scene.loaded_iter}"
        warn_if_elsewhere(ply, folder)


def _load_scene(
    dataset: argparse.Namespace,
    iteration: int,
    sh_degree: int | None,
    ply: str,
    pipeline: argparse.Namespace,
    load: Callable[..., Scene | WithoutScene] = load_saved,
) -> tuple[Scene | WithoutScene, torch.Tensor]:
    """Return the scene with the model of a saved iteration, or with that of the file `ply`, and the background (3,).

    load: function that loads a saved iteration; `saved_scene` also loads it without the scene.
    """
    options = copy.copy(dataset)
    options.images_to_load = 1  # each photo is used once; the store grows to those of a batch
    scene = load_file(options, ply, pipeline) if ply else load(options, iteration, sh_degree)
    if not ply and getattr(dataset, "other_scene", ""):
        scene.loaded_iter = f"{scene.loaded_iter}_{dataset.other_scene}"
    scene.loaded_iter = f"{scene.loaded_iter}{dataset.marks}" if getattr(dataset, "marks", "") else scene.loaded_iter
    if len(scene.gaussians) == 0:
        raise UserError(f"iteration {scene.loaded_iter} of {scene.model_path} has no Gaussians; train it again")
    views = *scene.getTrainCameras(), *scene.getTestCameras()
    check_views(pipeline, views)
    if not (ply or getattr(dataset, "other_scene", "")):
        warn_if_moved(scene.model_path, views)
    return scene, torch.full((3,), 1.0 if options.white_background else 0.0, device=compute_device())


def _read_small(path: Path) -> np.ndarray:
    """Read a picture at _SMALL: (h, w, 3) float64, 0 to 255."""
    with open_image(path) as image:
        return np.asarray(image.convert("RGB").resize(_SMALL), float)


def warn_if_elsewhere(model: str, folder: Path) -> None:
    """Warn if most renders of a set are no more like their own photo than like the photos of other views."""
    names = sorted(path.name for path in (folder / "renders").glob("*.png"))
    if len(names) < _FEWEST:
        return
    names = names[:: -(-len(names) // _COMPARED)]
    renders, photos = (np.stack([_read_small(folder / side / name) for name in names]) for side in ("renders", "gt"))
    errors = np.abs(renders[:, None] - photos).mean(axis=(2, 3, 4))
    fit = (errors.diagonal()[:, None] < errors).sum(axis=1) >= _BETTER * (len(names) - 1)
    if fit.mean() < _FITTING:
        text = f"{(~fit).sum()} of {len(fit)} renders are no more like their own photo than like others"
        print(
            f"warning: {model} may not be where the cameras are, as after a program has turned, moved or scaled it: "
            f"{text}; export it again in the cameras' frame",
            file=sys.stderr,
        )


def main() -> None:
    """Render what the command line asks for: views of a model, a video along a path, or the scene from above."""
    parser = OptionParser(description="Render the train and test views of a trained model, or a video of it.")
    # Each photo is used once, so few are kept in memory.
    model_params = ModelParams(parser, sentinel=True, without=("images_to_load",))
    pipeline_params = PipelineParams(parser, sentinel=True)
    parser.add_argument("--iteration", type=int, default=-1, help="saved iteration to render (default: -1, the last)")
    parser.add_argument("--ply", default="", metavar="FILE",
        help="render this model of any tool in the views of -s, as -m has none of its own (default: none)")  # fmt: skip
    parser.add_argument("--skip_train", action="store_true", help="leave the training views out (default: off)")
    parser.add_argument("--skip_test", action="store_true", help="leave the test views out (default: off)")
    for name, plane in PLANES.items():
        help_text = f"also write {plane.what}, 16-bit PNGs (default: off)"
        parser.add_argument(f"--{name}", action="store_true", help=help_text)
    other = "render views of another scene than the model's, into folders with its name (default: refuse)"
    parser.add_argument("--allow_other_scene", action="store_true", help=other)
    add_path_options(parser)
    parser.add_argument("--quiet", action="store_true", help="print nothing to stdout (default: off)")
    args = get_combined_args(parser)
    options, pipeline = model_params.extract(args), pipeline_params.extract(args)
    options.other_scene, options.marks = args.other_scene, args.marks
    safe_state(args.quiet)
    if args.other_scene and not (args.allow_other_scene or args.ply):
        trained = read_cfg_args(args.model_path)["source_path"]
        raise UserError(
            f"{args.model_path} is a model of another scene, {trained}; leave -s out, or give --allow_other_scene"
        )
    warn_of_background(options)
    request = path_request(args)
    if request:
        scene, background = _load_scene(options, args.iteration, args.typed_sh_degree, args.ply, pipeline, saved_scene)
        if request.make is None:
            from gaussian_renderer.camera_paths.from_above import render_top  # rarely needed

            render_top(scene, options.source_path, pipeline, background, request.size)
        else:
            render_path(scene, pipeline, background, request)
        return
    chosen = {
        "sh_degree": args.typed_sh_degree,
        "ply": args.ply,
        "planes": [plane for plane in PLANES if getattr(args, plane)],
    }
    render_sets(options, args.iteration, pipeline, args.skip_train, args.skip_test, **chosen)
