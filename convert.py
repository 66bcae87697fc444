"""Convert photos or a video to a scene for train.py: camera poses, points, photos that it can show.

python convert.py -s SCENE                 photos in SCENE/input
python convert.py -s SCENE --video FILE    frames of a video, written to SCENE/input
python convert.py -s SCENE --poses FILE    points at the poses of a transforms.json, or of a COLMAP model

Writes SCENE/images, SCENE/sparse/0, SCENE/convert_report.json, and intermediate results in SCENE/distorted. A second
run resumes after the last finished stage, and repeats the stages that changed options or photos affect.
"""

if __name__ == "__main__":
    import splatting.host.early  # noqa: F401  (before the other imports, which take a second)

import argparse
import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from arguments import OptionParser
from splatting.host.start import typed_command
from splatting.sfm import stages
from splatting.sfm.colmap import GIVEN, LENS_MODELS, Program, Pycolmap, Settings, is_native
from splatting.sfm.layout import FEWEST, Layout, find_images, refuse_foreign_results, scene_folder
from splatting.sfm.programs import refuse_while_working
from splatting.sfm.report import lens_words, summary
from utils.system_utils import UserError, run_cli


def convert(layout: Layout, settings: Settings, args: argparse.Namespace) -> None:
    """Run the stages that are not done; print how many photos were placed, and advice about the others."""
    masks = _masks(args.mask_path)
    names = [] if args.video else find_images(layout)
    refuse_while_working(layout.log)
    record = stages.StageRecord(layout.stages)
    refuse_foreign_results(layout, record.begun("undistortion"), record.begun("photos"), args.skip_matching)
    kept = []
    if args.video:
        kept = record.run([_video(layout, record, args)])
        names = find_images(layout)
    if args.skip_matching:
        planned = []
        program = "--skip_matching: the model that was in distorted/sparse"
        made_from = [names, stages.model_state(layout)]
    else:
        program = args.colmap_executable
        backend = Program(program, layout, settings) if program else Pycolmap(layout, settings)
        program, made_from = backend.identity, None
        planned = [stages.image_stage(layout, names, masks)]
        if args.poses:
            planned.append(stages.poses_stage(layout, Path(args.poses)))
        planned += stages.reconstruction_stages(backend, masks is not None)
    made = {"camera": settings.camera, "mapper": settings.mapper, "matcher": settings.matcher, "program": program}
    planned.append(stages.undistortion_stage(layout, settings, made_from, **made))
    if args.resize:
        planned.append(stages.resize_stage(layout))
    kept += record.run(planned)
    if kept:
        print(f"done before: {', '.join(kept)} (to start from the beginning, remove {layout.work})")
    report = json.loads(layout.report.read_text(encoding="utf-8"))
    print(summary(report))
    print(lens_words(report))
    for line in report["advice"]:
        print(f"warning: {line}", file=sys.stderr)
    print(f"train it with: {typed_command('train.py')} -s {shlex.quote(str(layout.scene))}")


def _masks(given: str | None) -> Path | None:
    """Return the folder of --mask_path. UserError if it is none: later it would pass for a folder without masks."""
    if given is None:
        return None
    if not given or not Path(given).is_dir():
        raise UserError(f"no folder of masks {given!r}; pass an existing folder as --mask_path, or omit the option")
    return Path(given)


def _video(layout: Layout, record: stages.StageRecord, args: argparse.Namespace) -> stages.Stage:
    video = Path(args.video)
    if not video.is_file():
        raise UserError(f"no video {video}; pass an existing file as --video")
    if layout.input.is_dir() and not record.begun("video") and any(layout.input.iterdir()):
        raise UserError(
            f"{layout.input} already has files, and the frames would be mixed with them; omit --video, or convert the "
            "video in another folder"
        )
    return stages.video_stage(layout, video, args.video_frames)


def _refuse_beside_poses(args: argparse.Namespace) -> None:
    """Raise UserError for an option that says what --poses says, or that needs what it leaves out."""
    for option in ("camera", "mapper", "video", "skip_matching", "colmap_executable"):
        if getattr(args, option):
            raise UserError(f"--{option} does not go with --poses, which gives poses and lenses to pycolmap; omit one")


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = OptionParser(description="Convert the photos in SCENE/input, or a video, to a scene for train.py.")
    add = parser.add_argument
    add("-s", "--source_path", required=True, metavar="SCENE",
        help="scene folder; its sub-folder input has the photos; --video makes a missing one")  # fmt: skip
    add("--poses", default="", metavar="FILE",
        help="poses and lenses that are given, by a transforms.json or the folder of a COLMAP model; only points are "
        "computed (default: all are computed)")  # fmt: skip
    add("--camera", default=None, help="lens model to fit; for a fisheye lens OPENCV_FISHEYE, for panoramas "
        "EQUIRECTANGULAR (default: OPENCV)")  # fmt: skip
    add("--lenses", choices=("auto", "native", "undistort"), default="auto",
        help="native: keep the photos as they are, with their lenses; undistort: resample them to pinhole images; "
        "auto: native for fisheyes and panoramas, undistort for others (default: auto)")  # fmt: skip
    add("--no_gpu", action="store_true", help="compute features and matches on the CPU even if there is a GPU")
    add("--skip_matching", action="store_true", help="only undistort the largest model in SCENE/distorted/sparse")
    add("--colmap_executable", default="", metavar="FILE",
        help="COLMAP program for features, matching and mapping (default: pycolmap does them)")  # fmt: skip
    add("--magick_executable", default="", metavar="FILE", help="no effect (Pillow resizes the photos)")
    add(
        "--resize", action="store_true", help="also write images_2, images_4, images_8, whose sides are divided by that"
    )
    add("--video", default="", metavar="FILE", help="take frames of this video as photos; needs imageio-ffmpeg")
    add("--video_frames", type=int, default=150, metavar="N",
        help="number of frames, the sharpest of each of N equal spans of time (default: 150)")  # fmt: skip
    add("--matcher", choices=("exhaustive", "sequential"), default=None,
        help="match every pair, or neighbours by name (default: exhaustive; with --video sequential)")  # fmt: skip
    add("--mapper", choices=("incremental", "global"), default=None,
        help="place one photo after another, or all at once, which is faster for hundreds of photos "
        "(default: incremental)")  # fmt: skip
    add("--max_num_features", type=int, default=8192, metavar="N",
        help="largest number of features per photo; more help on surfaces with little texture, but are slower "
        "(default: 8192)")  # fmt: skip
    add("--mask_path", default=None, metavar="FOLDER",
        help="masks with the photos' names and .png appended; black areas get no features (default: none)")  # fmt: skip
    add("stray", nargs="*", help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.stray:
        whole = " ".join([args.source_path, *args.stray])
        raise UserError(f"unexpected argument {args.stray[0]}; quote paths with spaces: -s {shlex.quote(whole)}")
    for option, least in (("max_num_features", 100), ("video_frames", FEWEST)):
        if getattr(args, option) < least:
            raise UserError(f"--{option} must be at least {least}, got {getattr(args, option)}")
    layout = Layout(scene_folder(args.source_path, made=bool(args.video)))
    if args.poses:
        _refuse_beside_poses(args)
        camera, mapper = "given", GIVEN
    else:
        camera, mapper = args.camera or "OPENCV", args.mapper or "incremental"
        if camera not in LENS_MODELS:
            raise UserError(f"--camera {camera} is not a supported lens model; choose one of {', '.join(LENS_MODELS)}")
    is_native(args.lenses, [camera])  # refuses what does not fit together
    matcher = args.matcher or ("sequential" if args.video else "exhaustive")
    convert(layout, Settings(camera, args.max_num_features, matcher, mapper, args.no_gpu, args.lenses), args)


if __name__ == "__main__":
    run_cli(main)
