"""Convert photos or a video to a scene for train.py: camera poses, points, photos that it can show.

python convert.py -s SCENE                 photos in SCENE/input
python convert.py -s SCENE --video FILE    frames of a video, written to SCENE/input
python convert.py -s SCENE --poses FILE    points at the poses of a transforms.json, or of a COLMAP model
python convert.py -s SCENE --add           new photos of SCENE/input beside those of a finished run

Writes SCENE/images, SCENE/sparse/0, SCENE/convert_report.json, and intermediate results in SCENE/distorted. A second
run resumes after the last finished stage, and repeats the stages that changed options or photos affect.
"""

import argparse
import json
import os
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from applications.convert import stages
from applications.convert.adding import describe_added, forget_base, keep_base
from applications.convert.cameras import MODES
from applications.convert.capture_page import capture_stage
from applications.convert.checks import describe_capture, training_options, why_unusable
from applications.convert.colmap import ADDING, GIVEN, LENS_MODELS, PANORAMA, Program, Pycolmap, Settings, is_native
from applications.convert.images import find_panoramas
from applications.convert.inputs import Inputs, describe_unused, sort_inputs
from applications.convert.layout import (
    FEWEST,
    Layout,
    find_images,
    refuse_foreign_results,
    scene_folder,
    take_photos_beside,
)
from applications.convert.orienting import describe_orientation
from applications.convert.programs import refuse_while_working
from applications.convert.report import describe_lenses, record_inputs, summarise
from applications.convert.video import FRAMES_MISSING, NOTE, describe_videos, list_report_entries, list_taken_frames
from arguments import OptionParser
from groundwork.host.listing import counted, some
from groundwork.host.start import typed_command
from scene.checks.conversion import awaits_conversion, file_state, read_stages
from scene.readers.scene_folder import WORK, find_capture, is_scene
from utils.system_utils import UserError

_NAMING = ("poses", "mask_path")  # options that name a file
_BESIDE_POSES = ("camera", "mapper", "video", "skip_matching", "colmap_executable")


def convert(layout: Layout, settings: Settings, args: argparse.Namespace) -> None:
    """Run the stages that are not done; print how many photos were placed, and advice about the others."""
    masks = _check_masks(args.mask_path)
    videos = _check_videos(args.video)
    if not args.skip_matching:
        take_photos_beside(layout, bool(videos))
    found = None if videos else find_images(layout, args.skip_unreadable)
    refuse_while_working(layout.log)
    record = stages.StageRecord(layout.stages)
    record.note("options", args.options)
    refuse_foreign_results(layout, record.begun("undistortion"), record.begun("photos"), args.skip_matching)
    if not videos and record.interrupted("video"):
        print(f"warning: {FRAMES_MISSING}", file=sys.stderr)
    kept = []
    if videos:
        kept = record.run([_video_stage(layout, videos, args)])
        print("\n".join(describe_videos(layout)))
        found = find_images(layout, args.skip_unreadable, but=videos)
    for line in describe_unused(found.unused):
        print(line)
    names = found.photos
    if not (args.camera or args.poses or args.add or args.skip_matching):
        settings = _detect_panoramas(settings, layout, names)
    record.note("files", {name: file_state(layout.input / name) for name in names})
    if args.skip_matching:
        planned = []
        program = "--skip_matching: the model that was in distorted/sparse"
        made_from = [names, stages.read_model_state(layout)]
    else:
        program = args.colmap_executable
        backend = Program(program, layout, settings) if program else Pycolmap(layout, settings)
        program, made_from = backend.identity, None
        if args.add:
            keep_base(layout, record.finished("undistortion"), names)
        else:
            forget_base(layout)
        planned = [stages.image_stage(layout, names, masks)]
        if args.poses:
            planned.append(stages.poses_stage(layout, Path(args.poses)))
        planned += stages.reconstruction_stages(backend, masks is not None)
    made = {"camera": settings.camera, "mapper": settings.mapper, "matcher": settings.matcher, "program": program}
    planned.append(stages.undistortion_stage(layout, settings, record, made_from, **made, shared_by=settings.cameras))
    planned.append(capture_stage(layout, names, record.seconds))
    planned += stages.requested_stages(layout, record, args)
    kept += record.run(planned)
    if kept:
        print(f"reused from an earlier run: {', '.join(kept)}; remove {layout.work} to start from the beginning")
    _print_outcome(layout, found, args.add)


def _detect_panoramas(settings: Settings, layout: Layout, names: Sequence[str]) -> Settings:
    """Take the lens of panoramas if the photos' XMP data name it; else say that photos of such sizes may be some."""
    wide, marked = find_panoramas(layout.input, names)
    if len(marked) == len(names):
        is_native(settings.lenses, [PANORAMA])  # refuses what does not fit together
        print(f"the photos are panoramas by their XMP data: taking --camera {PANORAMA}")
        return replace(settings, camera=PANORAMA)
    if wide:
        text = f"{len(wide)} of {len(names)} photos are twice as wide as high ({some(wide)})"
        print(f"{text}: for panoramas of 360 by 180 degrees, give --camera {PANORAMA}, and no other photos")
    return settings


def _print_outcome(layout: Layout, found: Inputs, adding: bool) -> None:
    """Print the results, and the command that trains the scene; exit with status 3 if it should not be trained."""
    notes = [NOTE] if list_taken_frames(layout) else []
    report = record_inputs(layout.report, notes=notes, unused=found.unused, videos=list_report_entries(layout))
    print(
        "\n".join(
            (summarise(report), describe_lenses(report), *describe_capture(report), *describe_orientation(layout))
        )
    )
    print(f"Report: {layout.page}")
    if found.unused:
        unused = counted(len(found.unused), "file")
        print(f"{unused} in {layout.input.name} not used; {layout.report.name} has the reasons")
    if adding:
        print(describe_added(layout, report["left_out"]))
    for line in notes:
        print(f"note: {line}")
    for line in report["advice"]:
        print(f"warning: {line}", file=sys.stderr)
    if text := why_unusable(report):
        print(f"warning: {text}", file=sys.stderr)
        sys.exit(3)
    folders = f"-s {shlex.quote(str(layout.scene))} -m {shlex.quote(f'output/{layout.scene.resolve().name}')}"
    print(f"train it with: {typed_command('train.py')} {folders} --eval {training_options(report)}".rstrip())


def convert_first(source: str) -> None:
    """Convert a folder of photos or videos that has no cameras yet, or finish its conversion, before train.py.

    Do nothing with any other folder. The photos are in the sub-folder `input`, or directly in the folder.
    """
    folder = Path(source)
    if not awaits_conversion(folder):
        return
    found = find_capture(folder.absolute())
    words, begun = ["--video", *map(str, found.videos)] if found.is_video else [], None
    if read_stages(folder):
        there = f"; to train what is there, remove {folder / WORK}" if is_scene(folder) else ""
        print(f"a conversion of {folder} was not finished: finishing it first{there}")
        begun = _read_begun_options(folder)
    else:
        print(f"{folder} has no cameras: converting what is in it first, as convert.py does without options")
        if found.is_video and found.photos:
            print(f"taking frames of {some([path.name for path in found.videos])}, which is more than the photos")
    main(["-s", str(folder.absolute()), *(words if begun is None else ())], **begun or {})


def _read_begun_options(folder: Path) -> dict[str, Any] | None:
    """Return the options of the conversion that was begun in a folder; None if files that they name are gone."""
    try:
        options = dict(read_stages(folder)["options"]["made_from"])
        named = [*options.get("video", []), *filter(None, map(options.get, _NAMING))]
        complete = all(map(os.path.exists, named))
    except (KeyError, TypeError, ValueError):
        return None
    if options.get("colmap_executable"):  # a program that a downloaded folder may name
        raise UserError(f"the conversion of {folder} was begun with --colmap_executable; finish it by that command")
    return options if complete else None


def _check_masks(given: str | None) -> Path | None:
    """Return the folder of --mask_path. UserError if it is none: later it would pass for a folder without masks."""
    if given is None:
        return None
    if not given or not Path(given).is_dir():
        raise UserError(f"no folder of masks {given!r}; pass an existing folder as --mask_path, or omit the option")
    return Path(given)


def _check_videos(given: Sequence[str]) -> list[Path]:
    videos = [Path(name) for name in given]
    for path in videos:
        if not path.is_file():
            raise UserError(f"no video {path}; pass existing files as --video, in quotes if their names have spaces")
    return videos


def _video_stage(layout: Layout, videos: Sequence[Path], args: argparse.Namespace) -> stages.Stage:
    """Make the stage of the videos. UserError for photos beside them that cannot be used, before minutes of work."""
    if layout.input.is_dir():
        sort_inputs(layout.input, args.skip_unreadable, but=videos)
    return stages.video_stage(layout, videos, args.video_frames)


def _make_settings(args: argparse.Namespace) -> Settings:
    """Return the settings of the command line. UserError for options that do not fit together."""
    of_matching = "camera", "cameras", "mapper", "matcher", "mask_path", "colmap_executable"
    if args.skip_matching and (ignored := [f"--{name}" for name in of_matching if getattr(args, name)]):
        print(f"warning: --skip_matching ignores {', '.join(ignored)}, as the model is there", file=sys.stderr)
    if args.add:
        _refuse_beside("add", "which keeps the poses of pycolmap's model", args, "poses", *_BESIDE_POSES)
    if args.poses:
        _refuse_beside("poses", "which gives poses and lenses to pycolmap", args, *_BESIDE_POSES)
        if args.cameras:
            print("warning: --cameras has no effect beside --poses, which gives each photo its camera", file=sys.stderr)
        camera, mapper = "given", GIVEN
    else:
        camera, mapper = args.camera or "OPENCV", ADDING if args.add else args.mapper or "auto"
        if camera not in LENS_MODELS:
            raise UserError(f"--camera {camera} is not a supported lens model; choose one of {', '.join(LENS_MODELS)}")
    is_native(args.lenses, [camera])  # refuses what does not fit together
    matcher, shared_by = args.matcher or "auto", args.cameras or "per_lens"
    return Settings(camera, args.max_num_features, matcher, mapper, args.no_gpu, shared_by, args.lenses)


def _refuse_beside(option: str, reason: str, args: argparse.Namespace, *others: str) -> None:
    """Raise UserError for options that do not go with one: they say the same, or need what that one leaves out."""
    for other in others:
        if getattr(args, other):
            raise UserError(f"--{other} does not go with --{option}, {reason}; omit one")


def main(argv: Sequence[str] | None = None, **options: Any) -> None:
    """Run the command line. options: beside those of argv."""
    parser = OptionParser(description="Convert the photos in SCENE/input, or a video, to a scene for train.py.")
    add = parser.add_argument
    add("-s", "--source_path", required=True, metavar="SCENE",
        help="scene folder; its sub-folder input has the photos; --video makes a missing one")  # fmt: skip
    add("--poses", default="", metavar="FILE",
        help="poses and lenses that are given, by a transforms.json or the folder of a COLMAP model; only points are "
        "computed (default: all are computed)")  # fmt: skip
    add("--add", action="store_true", help="place new photos of SCENE/input beside those of a finished run, which keep "
        "their poses (default: new photos let a run begin anew)")  # fmt: skip
    add("--camera", default=None, help="lens model to fit; for a fisheye lens OPENCV_FISHEYE, for panoramas "
        "EQUIRECTANGULAR (default: OPENCV)")  # fmt: skip
    add("--cameras", choices=MODES, default=None,
        help="which photos of one size share a camera: those that EXIF data give one lens and focal length (where they "
        "name none, those of one sub-folder), those of a sub-folder, none, or all (default: per_lens)")  # fmt: skip
    add("--lenses", choices=("auto", "native", "undistort"), default="auto",
        help="native: keep the photos as they are, with their lenses; undistort: resample them to pinhole images; "
        "auto: native for fisheyes and panoramas, undistort for others (default: auto)")  # fmt: skip
    add("--no_gpu", action="store_true", help="compute features and matches on the CPU even if there is a GPU")
    add("--skip_matching", action="store_true", help="only undistort the largest model in SCENE/distorted/sparse")
    add("--colmap_executable", default="", metavar="FILE",
        help="COLMAP program for features, matching and mapping (default: pycolmap does them)")  # fmt: skip
    add("--skip_unreadable", action="store_true", help="leave out photos that cannot be read, and name them")
    add("--magick_executable", default="", metavar="FILE", help="no effect (Pillow resizes the photos)")
    add("--resize", action="store_true",
        help="also write images_2, images_4, images_8, whose sides are divided by that")  # fmt: skip
    add("--orient", action="store_true", help="find where the scene is upright, and its size by GPS, for exports")
    add("--video", nargs="+", action="extend", default=[], metavar="FILE",
        help="take frames of these videos as photos, besides those in input; needs pip install '.[video]'")  # fmt: skip
    add("--video_frames", type=int, default=150, metavar="N",
        help="largest number of frames of each video, the sharpest of each of N equal parts of its motion "
        "(default: 150)")  # fmt: skip
    add("--matcher", choices=("auto", "exhaustive", "sequential"), default=None,
        help="auto: match every pair of few photos, and of many those that are near by name, by GPS and by look; "
        "exhaustive: every pair; sequential: neighbours by name (default: auto)")  # fmt: skip
    add("--mapper", choices=("auto", "incremental", "global"), default=None,
        help="incremental: place one photo after another; global: all at once; auto: in several ways, until the poses "
        "agree with the matches (default: auto)")  # fmt: skip
    add("--max_num_features", type=int, default=8192, metavar="N",
        help="largest number of features per photo; more help on surfaces with little texture, but are slower "
        "(default: 8192)")  # fmt: skip
    add("--mask_path", default=None, metavar="FOLDER",
        help="masks with the photos' names and .png appended; black areas get no features (default: none)")  # fmt: skip
    parser.set_defaults(**options)
    args = parser.parse_args(argv)
    named = {name: os.path.abspath(path) for name in _NAMING if (path := getattr(args, name))}
    args.options = {**vars(args), **named, "video": [*map(os.path.abspath, args.video)]}
    for option, least in (("max_num_features", 100), ("video_frames", FEWEST)):
        if getattr(args, option) < least:
            raise UserError(f"--{option} must be at least {least}, got {getattr(args, option)}")
    layout = Layout(scene_folder(args.source_path, made=bool(args.video)))
    try:
        convert(layout, _make_settings(args), args)
    except json.JSONDecodeError as error:
        raise UserError(f"a report in {layout.scene} is damaged; remove {layout.work} to begin anew") from error
