"""Write a trained model in the file format of another program.

python export.py -m MODEL --to FILE [--to FILE ...] [--iteration N] [--sh_degree D] [--max_splats N]
python export.py MODEL_OF_ANY_TOOL --to FILE

The ending of FILE names the format; applications/export/formats.py has the table.
"""

from __future__ import annotations

import argparse
import functools
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import groundwork.host.openmp  # noqa: F401  isort: skip  (before torch)
import numpy as np
import torch

from applications.export.cleaning import OPTION as CLEAN_OPTION
from applications.export.cleaning import check_clean, clean_scene, write_comparison
from applications.export.formats import ENDINGS, FORMATS, Format, SceneInputs, find_format
from applications.export.importance import most_needed
from applications.export.notes import read_notes
from applications.export.reading import ANY, read_any
from applications.export.upright import add_upright_options, check_upright, follows_scene, move_upright
from arguments import ModelParams, OptionParser, PipelineParams, get_combined_args
from gaussian_renderer.camera_paths.without_scene import (
    WithoutScene,
    circle_cameras,
    recorded_cameras,
    recorded_cameras_file,
    warn_if_moved,
)
from gaussian_renderer.scored_views import ScoredViews
from gaussian_renderer.trimming import change_on_views
from groundwork.files.json_files import read_model_json
from groundwork.files.ours import refuse_foreign
from groundwork.host.memory import free_memory
from scene.cameras import Camera
from scene.saved_model import find_save, load_saved, read_model
from scene.scene import Scene
from scene.splats.reading import READABLE
from scene.splats.splats import Splats, choose, selected, tidy, used_sh_degree, with_sh_degree
from scene.splats.spz import WRITTEN
from scene.with_splats import load_file, model_of, place, splats_of
from splatting.registry import PARTS
from utils.general_utils import safe_state
from utils.system_utils import UserError, compute_device

if TYPE_CHECKING:  # SciPy takes a while to import
    from gaussian_renderer.camera_paths.keyframes import TimedPath
    from gaussian_renderer.camera_paths.poses import Poses

_PHOTOS = 0.25  # of the free memory, that the photos of a cleaning may take
FOR_PHONES = 500_000  # Gaussians of a page
FEWEST = 100  # triangles that --triangles may ask for
_DETAILS = "voxel", "triangles", "start", "title", "notes", "walk"  # of `SceneInputs`


def load(
    args: argparse.Namespace, options: argparse.Namespace, needs_views: bool, needs_photos: bool
) -> tuple[Splats, Scene | WithoutScene | None]:
    """The splats that the command line names, and the scene if views are wanted, also without photos where it is gone.

    options: the model options. UserError if there is nothing to load, or what is needed is not there.
    """
    if needs_views and not args.model_path:
        raise UserError(
            "--max_splats, --clean, --walk and meshes need training views; give their model folder with -m, and beside "
            f"it --ply {args.ply}"
        )
    record = recorded_cameras_file(options) if needs_views and not needs_photos else None
    if needs_views and record is None:
        cleaned = bool(_list_cleaned_files(args))
        options.images_to_load = 0 if cleaned else 1  # a cleaning uses each photo many times, all else once or twice
        smooth = argparse.Namespace(antialiasing=bool(args.antialiasing))
        scene = load_file(options, args.ply, smooth) if args.ply else load_saved(options, args.iteration)
        if cleaned:
            _keep_photos(scene)
        return splats_of(scene.gaussians, smooth.antialiasing), scene
    if args.ply:
        splats = read_any(args.ply)
        splats = replace(splats, antialiasing=splats.antialiasing or bool(args.antialiasing))
    else:
        _, path = find_save(options.model_path, args.iteration)
        gaussians = read_model(path)
        place(gaussians, options.model_path)
        splats = splats_of(gaussians, bool(args.antialiasing))
    if record is None:
        return splats, None
    cameras = recorded_cameras(record, options.resolution)
    return splats, WithoutScene(model_of(splats), options.model_path, args.iteration, cameras)


def _keep_photos(scene: Scene) -> None:
    """Begin to decode the photos of the training views, all of which are kept; one of them where memory is short."""
    free = free_memory(scene.images.keep_on)
    if free is not None and scene.images.planned_bytes > _PHOTOS * free:
        scene.images.limit = 1
    else:
        scene.prefetch(scene.getTrainCameras())


@torch.no_grad()
def thin_out(
    scene: Scene,
    keep: np.ndarray,
    sh_degree: int,
    count: int,
    pipe: argparse.Namespace,
    options: argparse.Namespace,
    unscored: str,
) -> np.ndarray:
    """Choose the `count` Gaussians of the mask `keep` that the training views need most.

    Prints the loss, if any Gaussians go. Returns indices, of the most needed Gaussian first.
    unscored: reason why the loss is not known; empty: it is known.
    """
    every, cameras = scene.gaussians, scene.getTrainCameras()
    kept = np.flatnonzero(keep)
    before = every.part(torch.from_numpy(keep).to(every.get_xyz.device), sh_degree)
    background = torch.full((3,), 1.0 if options.white_background else 0.0, device=compute_device())
    views = ScoredViews(pipe, background, scene.halves)
    chosen = most_needed(before, cameras, views, count)
    if len(chosen) < len(kept):
        loss = f"no score, as {unscored}"
        if not unscored:
            change = change_on_views(before, before.part(chosen, sh_degree), cameras, views, scored=True)
            one, other = change["psnr_before"], change["psnr_after"]
            loss = f"training views {one:.2f} -> {other:.2f} dB ({other - one:+.2f} dB)"
        print(f"{len(kept):,} -> {count:,} Gaussians: {loss}; train.py --max_num_splats {count} gives a better one")
    return kept[chosen.cpu().numpy()]


def find_sky(model: str | None, means: np.ndarray) -> np.ndarray:
    """Return a mask (N,) of the Gaussians with centres (N, 3) that are a model's sky. UserError without a sky."""
    facts = read_model_json(Path(model)) if model else {}
    found = [mask for part in PARTS if (mask := part.backdrop(facts, torch.from_numpy(means))) is not None]
    if not found:
        raise UserError("--no_sky needs a model folder (-m) that was trained with a sky; leave it out")
    return found[0].numpy()


def find_needed(
    scene: Scene, most: float, pipe: argparse.Namespace, options: argparse.Namespace, picture: Path
) -> np.ndarray:
    """Return a mask (N,) of the Gaussians that training views need, to within `most` dB each; print the rest.

    picture: file for a picture of the removed Gaussians, None: none."""
    cleaning, views = clean_scene(scene, most, pipe, options.white_background)
    if not cleaning.keep.all():
        write_comparison(picture, scene.gaussians, cleaning.keep, scene.getTrainCameras(), views)
        print(f"{picture}: before, gone, after")
    return cleaning.keep.cpu().numpy()


def _name_removed_picture(to: str) -> Path:
    """Name the picture of what was removed, beside the file of --to."""
    return Path(to).with_name(f"{Path(to).name}.removed.png")


def _list_cleaned_files(args: argparse.Namespace) -> list[str]:
    """The files that hold what --clean leaves, where there are photos."""
    by_itself = bool(args.model_path) and not args.raw
    return [to for to in args.to if args.clean or (find_format(to).clean and by_itself)]


def make_chooser(
    args: argparse.Namespace,
    options: argparse.Namespace,
    pipe: argparse.Namespace,
    splats: Splats,
    scene: Scene | WithoutScene | None,
) -> Callable[[str], Splats]:
    """Make a function that chooses the splats of a file of --to; it computes once what several files need."""
    degree = used_sh_degree(splats) if args.typed_sh_degree is None else min(args.typed_sh_degree, splats.sh_degree)
    keep = choose(splats, args.crop, args.min_opacity)
    if args.no_sky:
        keep &= ~find_sky(args.model_path, splats.means)
    of_cleaned = _list_cleaned_files(args) if isinstance(scene, Scene) else []
    unscored = "" if isinstance(scene, Scene) else "the photos are gone"
    unscored = "photos show more than the crop" if args.crop else unscored

    @functools.cache
    def needed(clean: bool) -> np.ndarray:
        most = args.clean or CLEAN_OPTION["const"]
        return keep & find_needed(scene, most, pipe, options, _name_removed_picture(of_cleaned[0])) if clean else keep

    @functools.cache
    def chosen(clean: bool, thin: bool) -> Splats:
        rows = needed(clean)
        rows = thin_out(scene, rows, degree, args.max_splats, pipe, options, unscored) if thin else rows
        return tidy(with_sh_degree(selected(splats, rows), degree))

    def splats_for(to: str) -> Splats:
        clean, in_order = to in of_cleaned, find_format(to).in_order
        return chosen(clean, bool(args.max_splats and (in_order or needed(clean).sum() > args.max_splats)))

    return splats_for


def export(args: argparse.Namespace, options: argparse.Namespace, pipe: argparse.Namespace) -> None:
    """Write the files that the command line asks for. UserError if there is nothing to load or to write."""
    entries = [find_format(to) for to in args.to]
    _check_fitting(args, entries)
    make_path = _make_path_maker(args.path)
    for to, entry in zip(args.to, entries, strict=True):
        if "spz_version" not in entry.options or args.spz_version in (None, WRITTEN[0]):
            entry.check(to)
        _refuse_to_replace_a_model(Path(to), args.ply)
    check_upright(args)
    for to in _list_cleaned_files(args)[:1]:
        refuse_foreign(_name_removed_picture(to))
    needs_views = bool(args.max_splats or args.clean or args.walk) or follows_scene(args)
    needs_views |= any(entry.of_scene and (args.model_path or not entry.around) for entry in entries)
    splats, scene = load(args, options, needs_views, needs_photos=bool(args.clean))
    if isinstance(scene, WithoutScene) and _list_cleaned_files(args):
        print(f"not cleaned, as there is no scene folder {options.source_path}; name it with -s", file=sys.stderr)
    if scene:
        _check_views(args, make_path, scene.getTrainCameras())
    splats_for = make_chooser(args, options, pipe, splats, scene)
    if getattr(pipe, "projection", "ewa") == "ray":
        print("The model was trained with --projection ray; other programs draw large Gaussians off axis differently")
    background = (1.0, 1.0, 1.0) if options.white_background else (0.0, 0.0, 0.0)
    in_place: dict[tuple[int, bool], tuple[Splats, SceneInputs | None]] = {}
    for to, entry in zip(args.to, entries, strict=True):
        chosen = splats_for(to)
        start = time.perf_counter()
        if (key := (id(chosen), entry.of_scene)) not in in_place:
            around = None
            if entry.of_scene:
                cameras = scene.getTrainCameras() if scene else circle_cameras(chosen.means)
                details = {name: getattr(args, name) for name in _DETAILS}
                around = SceneInputs(cameras, background, pipe, make_path, **details, made={})
            in_place[key] = move_upright(args, entry.of_scene, chosen, around)
        chosen, around = in_place[key]
        how = [around] if around else [args.spz_version or WRITTEN[0]] if "spz_version" in entry.options else []
        what = entry.write(to, chosen, *how)
        print(
            f"Wrote {to}: {_describe_file(to, entry, what, chosen, splats, args)}, {time.perf_counter() - start:.1f} s"
        )
        if "walk" in entry.options and len(chosen) > FOR_PHONES:
            print(f"Phones show up to {FOR_PHONES:,} Gaussians smoothly; make a page for them by --max_splats")


def _describe_file(
    to: str, entry: Format, what: str | None, chosen: Splats, splats: Splats, args: argparse.Namespace
) -> str:
    """Describe a written file and its size. what: the writer's own description; None: the file has splats."""
    size = Path(to).stat().st_size
    if what is not None:
        return f"{what}, {size / 1e6:.2f} MB"
    spare = args.typed_sh_degree is None and entry.bands and chosen.sh_degree < splats.sh_degree
    degree = chosen.sh_degree if entry.bands else 0
    what = f"{len(chosen):,} of {len(splats):,} Gaussians, SH degree {degree}{' (higher bands are zero)' * spare}"
    return f"{what}, {size / 1e6:.2f} MB ({size / max(len(chosen), 1):.0f} bytes each)"


def _refuse_to_replace_a_model(file: Path, source: str | None) -> None:
    """Raise UserError if a file to write is a folder, a trained model, or the source of the export."""
    if file.is_dir():
        raise UserError(f"--to {file} is a folder; give the name of a file")
    saved = file.absolute().parent.parent.name == "point_cloud"
    saved |= file.name == "input.ply" and (file.parent / "cfg_args").is_file()
    if saved and file.exists() or (source and file.exists() and file.samefile(source)):
        raise UserError(f"--to {file} would overwrite a trained model or its input; choose another file")


def _check_fitting(args: argparse.Namespace, entries: Sequence[Format]) -> None:
    """UserError for an option that is for files of other kinds, and for a file that is named twice."""
    if twice := [to for place, to in enumerate(args.to) if to in args.to[:place]]:
        raise UserError(f"--to {twice[0]} is given twice; give each file once")
    for option in ("path", *_DETAILS, "raw", "spz_version"):
        if getattr(args, option) and not any(option in entry.options for entry in entries):
            endings = " or ".join(other.ending for other in FORMATS if option in other.options)
            raise UserError(f"--{option} is for {endings}; leave it out, or end --to with {endings}")
    if args.notes:
        read_notes(args.notes)


def _check_views(
    args: argparse.Namespace, make_path: Callable[[Poses], TimedPath] | None, cameras: list[Camera]
) -> None:
    """UserError for a --start, --notes or --path that the training views do not have, before they are rendered.

    A warning if the views are not those of the training.
    """
    from applications.export.page_start import check_note, find_named
    from gaussian_renderer.camera_paths.poses import poses_of  # SciPy takes a while to import

    if not args.ply:
        warn_if_moved(args.model_path, cameras)
    names = [str(camera.image_name) for camera in cameras]
    if args.start is not None:
        find_named(args.start, names, f"--start {args.start}")
    for note in read_notes(args.notes).views if args.notes else ():
        check_note(note, cameras)
    if make_path and cameras:
        make_path(poses_of(cameras))


def _make_path_maker(path: str | None) -> Callable[[Poses], TimedPath] | None:
    """Make a function that makes the animation of a page; None: the page's own."""
    if path is None:
        return None
    from gaussian_renderer.camera_paths.render_path import path_maker

    return path_maker(path)


def options() -> tuple[argparse.ArgumentParser, ModelParams, PipelineParams]:
    """The parser of the command line, and its groups of options."""
    parser = OptionParser(description="Write a trained model in the file format of another program.")
    without = ("images_to_load", "sh_degree")
    model_params = ModelParams(parser, sentinel=True, without=without)
    pipeline_params = PipelineParams(parser, sentinel=True)
    add = parser.add_argument
    add("--to", required=True, action="append", metavar="FILE",
        help=f"file to write; its ending is the format. May be given again, for several files. {ENDINGS}")  # fmt: skip
    add("file", nargs="?", default="", metavar="MODEL", help=f"write this model, of any tool, without a scene: {ANY}")
    add("--iteration", type=int, default=-1, help="saved iteration to write (default: -1, the last)")
    add(
        "--ply",
        metavar="FILE",
        help=f"write this model, of any tool, instead of that of -m: {READABLE} (default: none)",
    )
    add("--sh_degree", type=int, choices=range(4), metavar="D",
        help="leave SH bands above D out (default: those that are zero throughout)")  # fmt: skip
    add("--crop", type=float, nargs=6, metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="keep the Gaussians with a centre in this box, in the frame of the model (default: keep all)")  # fmt: skip
    add("--min_opacity", type=float, default=0.0, help="leave fainter Gaussians out, 0 to 1 (default: 0)")
    add("--no_sky", action="store_true", help="leave out the sky that training has added (default: keep it)")
    add("--clean", **CLEAN_OPTION, help="leave out floaters and what else the training views do not need, while none "
        "loses more than this (default: off; 0.05 without a number)")  # fmt: skip
    add("--max_splats", type=int, default=0, metavar="N",
        help="keep N Gaussians; what adds least to the training views goes first (default: no limit)"
        ).above_zero = True  # fmt: skip
    add("--path", metavar="PATH",
        help="animation of an .html: interpolate, ellipse, spiral, or a JSON file of keyframes "
        "(default: around the model, or a sway if the first camera is within it)")  # fmt: skip
    add("--start", metavar="PHOTO", help="training photo that an .html begins at (default: one that looks straight at "
        "the middle)")  # fmt: skip
    add("--title", metavar="TEXT", help="title of an .html (default: the name of the file)")
    add("--notes", metavar="FILE", help="text with title, author, date and licence of an .html, and notes on views "
        "(docs/guide/web_pages.md; default: none)")  # fmt: skip
    add("--walk", action="store_true", help="let guests of an .html walk on the floor and stop at walls (default: off)")
    add("--raw", action="store_true", help="do not --clean an .html (default: cleaned, if its scene is there)")
    add("--spz_version", type=int, choices=WRITTEN, metavar="N",
        help="version of an .spz: 4, or 3 or 2 for programs that do not read it (default: 4)")  # fmt: skip
    add("--voxel", type=float, metavar="UNITS",
        help="size of a mesh's voxels in the scene's unit (default: two pixels at the median depth)")  # fmt: skip
    add("--triangles", type=int, metavar="N",
        help="triangles of a mesh, at most (default: all of a mesh.ply, 200000 of one with a texture)")  # fmt: skip
    add_upright_options(add)
    add("--quiet", action="store_true", help="print nothing to stdout (default: off)")
    return parser, model_params, pipeline_params


def parse(parser: argparse.ArgumentParser, argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Parse the command line; with --ply, no model folder is read. UserError for values out of range."""
    args = parser.parse_args(argv)
    if args.file and (args.ply or args.model_path):
        raise UserError(f"{args.file} stands alone; beside -m or --ply, give one file by --ply and leave it out")
    args.ply = args.file or args.ply
    if not 0 <= args.min_opacity <= 1:
        raise UserError(f"--min_opacity must be from 0 to 1, got {args.min_opacity}")
    if args.max_splats < 0:
        raise UserError(f"--max_splats must be above 0, got {args.max_splats}")
    check_clean(args.clean)
    if args.raw and args.clean:
        raise UserError("--raw and --clean contradict each other; leave one out")
    if args.voxel is not None and not 0 < args.voxel < math.inf:
        raise UserError(f"--voxel must be above 0, got {args.voxel}")
    if args.triangles is not None and args.triangles < FEWEST:
        raise UserError(f"--triangles must be {FEWEST} or above, got {args.triangles}")
    if args.crop and not all(low < high for low, high in zip(args.crop[:3], args.crop[3:], strict=True)):
        raise UserError(f"--crop takes the smaller corner first, x0 y0 z0 x1 y1 z1, got {args.crop}")
    if args.model_path or not args.ply:
        return get_combined_args(parser, argv)
    args.typed_sh_degree = args.sh_degree
    return args


def main() -> None:
    parser, model_params, pipeline_params = options()
    args = parse(parser)
    safe_state(args.quiet)
    export(args, model_params.extract(args), pipeline_params.extract(args))
