"""Paths of a conversion, and checks of the folder that is given, with messages that name the fix."""

import os
from collections.abc import Iterable
from pathlib import Path

from applications.convert.inputs import Inputs, describe_unused, sort_inputs
from groundwork.files.image_files import SUFFIXES, VIDEO_SUFFIXES
from groundwork.files.similarity import FILE
from groundwork.host.listing import some
from scene.readers.scene_folder import FEWEST, WORK, find_capture, how_to_convert, scene_above
from utils.system_utils import UserError


class Layout:
    """Paths of one conversion: `input`, the photos, which are only read; `work`, intermediate results; the scene."""

    def __init__(self, scene: Path) -> None:
        """Name the paths of a conversion. scene: folder of the scene, with the folder `input`."""
        self.scene = scene
        self.input, self.images, self.sparse = scene / "input", scene / "images", scene / "sparse"
        self.report, self.page = scene / "convert_report.json", scene / "capture.html"
        self.orientation = scene / FILE
        self.work = work = scene / WORK
        self.prepared = work / "photos"  # for COLMAP: upright, in formats that it reads
        self.small = work / "small"  # copies of those, in which features are found
        self.masks, self.undistorted = work / "masks", work / "undistorted"
        self.models = work / "sparse"  # one sub-folder per model of the mapper: 0, 1, ...
        self.database = work / "database.db"
        self.calibrated = work / "calibrated.db"  # a copy with focal lengths that the pairs tell
        self.tried = work / "tried"  # models of each way of mapping, until one is chosen
        self.survey = work / "survey.json"  # what the models contain
        self.judged = work / "judged.json"  # how far each agrees with its pairs, the chosen one first
        self.frames = work / "frames.json"  # which of `input` are frames of videos
        self.base = work / "base"  # what --add adds to
        self.base_database, self.base_model = self.base / self.database.name, self.base / "model"
        self.given = work / "given.json"  # poses and cameras of --poses, for the photos that are here
        self.capture = work / "capture.json"  # of worker.py, for the report of the capture
        self.log, self.stages = work / "colmap.log", work / "stages.json"

    def resized(self, factor: int) -> Path:
        return self.scene / f"images_{factor}"


def scene_folder(given: str, made: bool = False) -> Path:
    """Return the absolute path of the folder given as -s. UserError if it is none; the message names usual mistakes.

    made: the folder may be missing, since a video's frames will make it.
    """
    bare = given.strip("'\"")
    if bare != given and not Path(given).exists() and Path(bare).exists():
        raise UserError(f"the path given as -s contains quotes: {given}; pass {bare}, quoted only once for the shell")
    folder = Path(given)
    if folder.is_file():
        hint = "pass its folder as -s and the video as --video" if folder.suffix.lower() in VIDEO_SUFFIXES else ""
        raise UserError(
            f"{given} is a file; {hint or 'pass the folder that contains the folder input with the photos as -s'}"
        )
    if not given or not (made or folder.is_dir()):
        raise UserError(f"no folder {given}; make it, put the photos into a folder input in it, and pass it as -s")
    return folder.absolute()


def take_photos_beside(layout: Layout, is_video: bool) -> None:
    """Take photos in the scene folder itself as input if `input` has no files; else say that they are not used.

    is_video: frames of a video will be written into `input`. UserError if `input` is no folder, or where nothing can be
    written.
    """
    if os.path.lexists(layout.input) and not layout.input.is_dir():
        what = "a file" if layout.input.is_file() else "a link to nothing"
        raise UserError(f"{layout.input} is {what}; remove it, and make a folder of that name for the photos")
    for folder in (layout.scene, layout.work):
        nearest = next(path for path in (folder, *folder.parents) if path.exists())
        if not os.access(nearest, os.W_OK | os.X_OK):
            raise UserError(f"{nearest} is read-only; copy the photos to a folder of your own, and pass it as -s")
    found = find_capture(layout.scene)
    if found.place == layout.scene and not is_video:
        foreign = scene_above(layout.scene) or (layout.scene / "cfg_args").is_file() or layout.scene.name == "input"
        if found.photos and (layout.stages.is_file() or not foreign):
            layout.input = layout.scene
        return
    used = {path.name for path in found.photos if found.place == layout.input}
    if unused := [path.name for path in found.beside if path.name not in used]:
        print(f"not used: {some(unused)} (beside the folder input: move them into it)")


def find_images(layout: Layout, skip_unreadable: bool = False, but: Iterable[Path] = ()) -> Inputs:
    """Sort the files below `input`, with its sub-folders, as `sort_inputs` does.

    UserError if there are too few photos, if some cannot be read, or if they are in another folder.
    """
    if not layout.input.is_dir():
        raise UserError(_explain_no_input(layout))
    made = layout.report, layout.page, layout.orientation
    found = sort_inputs(layout.input, skip_unreadable, (*but, *made), below=layout.input != layout.scene)
    if len(found.photos) < FEWEST:
        raise UserError(
            f"{layout.input}: fewer than {FEWEST} readable photos ({len(found.photos)}); "
            f"{'; '.join(['add more (20 to 200 with much overlap are usual)', *describe_unused(found.unused)])}"
        )
    return found


def image_names(folder: Path) -> list[str]:
    """List the photos below a folder, without hidden files, by the names that COLMAP gives them, sorted."""
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if _is_image(path))


def _explain_no_input(layout: Layout) -> str:
    """Return the message for a scene without the folder `input`, by what lies there instead."""
    scene = layout.scene
    if scene.name == "input":
        return f"{scene} is the folder of the photos itself; pass its parent folder as -s: {scene.parent}"
    if (scene / "cfg_args").is_file():
        return f"{scene} is a model that train.py wrote; pass the folder of its photos as -s"
    if above := scene_above(scene):
        return (
            f"no folder input in {scene}, which {'is' if above == scene else 'lies in'} a scene already: train.py "
            f"takes it as it is; to convert again, make {above / 'input'} and put the photos there"
        )
    remedy = how_to_convert(scene) or "make it and put the photos there, or pass a video as --video"
    return f"no folder input in {scene}; {remedy}"


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()


def _has(path: Path, form: str | None) -> bool:
    """Tell if a file contains a text that only files of convert.py have."""
    return form is not None and path.is_file() and form in path.read_text(encoding="utf-8", errors="replace")


def refuse_foreign_results(layout: Layout, scene_made: bool, work_made: bool, skip_matching: bool) -> None:
    """Raise UserError if writing would overwrite a scene or a COLMAP project that convert.py did not make.

    scene_made, work_made: whether an earlier run here began to write the scene, or into the work folder.
    """
    forms = dict.fromkeys((layout.images, layout.sparse, layout.orientation))
    forms |= {layout.report: '"left_out"', layout.page: "<title>Capture: "}
    scene_made = scene_made or _has(layout.report, forms[layout.report])  # of a run whose work folder was removed
    there = [] if scene_made else [path.name for path, form in forms.items() if path.exists() and not _has(path, form)]
    owned = (
        work_made
        or skip_matching
        or not layout.work.exists()
        or {path.name for path in layout.work.iterdir()} <= {layout.stages.name, layout.frames.name}
    )
    if not owned:
        there.append(layout.work.name)
    if there:
        raise UserError(
            f"{layout.scene} already has {' and '.join(there)}, which convert.py did not make and will not overwrite; "
            "move them away, or convert in another folder"
            + ("; --skip_matching uses the model in distorted/sparse" if layout.models.is_dir() and not owned else "")
        )
