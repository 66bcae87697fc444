"""Paths of a conversion, and checks of the folder that is given, with messages that name the fix."""

from collections.abc import Iterable
from pathlib import Path

from scene.readers.scene_folder import is_scene
from splatting.files.image_files import SUFFIXES
from splatting.files.similarity import FILE
from splatting.sfm.inputs import VIDEO_SUFFIXES, Inputs, sort_inputs, unused_lines
from utils.system_utils import UserError

FEWEST = 3


class Layout:
    """Paths of one conversion: `input`, the photos, which are only read; `work`, intermediate results; the scene."""

    def __init__(self, scene: Path) -> None:
        self.scene = scene
        self.input, self.images, self.sparse = scene / "input", scene / "images", scene / "sparse"
        self.report, self.page = scene / "convert_report.json", scene / "capture.html"
        self.orientation = scene / FILE
        self.work = work = scene / "distorted"
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


def find_images(layout: Layout, skip_unreadable: bool = False, but: Iterable[Path] = ()) -> Inputs:
    """Sort the files below `input`, with its sub-folders, as `sort_inputs` does.

    UserError if there are too few photos, if some cannot be read, or if they are in another folder.
    """
    if not layout.input.is_dir():
        raise UserError(_no_input(layout))
    found = sort_inputs(layout.input, skip_unreadable, but)
    if len(found.photos) < FEWEST:
        raise UserError(
            f"{layout.input}: fewer than {FEWEST} readable photos ({len(found.photos)}); "
            f"{'; '.join(['add more (20 to 200 with much overlap are usual)', *unused_lines(found.unused)])}"
        )
    return found


def image_names(folder: Path) -> list[str]:
    """List the photos below a folder, without hidden files, by the names that COLMAP gives them, sorted."""
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if _is_image(path))


def _no_input(layout: Layout) -> str:
    scene = layout.scene
    if scene.name == "input":
        return f"{scene} is the folder of the photos itself; pass its parent folder as -s: {scene.parent}"
    if (scene / "cfg_args").is_file():
        return f"{scene} is a model that train.py wrote; pass the folder of its photos as -s"
    if is_scene(scene):
        return (
            f"no folder input in {scene}, which is a scene already: train.py takes it as it is; to convert again, make "
            f"{layout.input} and put the photos there"
        )
    beside = sum(map(_is_image, scene.iterdir()))
    if beside:
        return (
            f"no folder input in {scene}, but {beside} photos directly in it; make {layout.input}, move them there, "
            f"and run again with -s {scene}"
        )
    if (scene / "images").is_dir():
        return f"no folder input in {scene}; rename its folder images to input"
    return f"no folder input in {scene}; make it and put the photos there, or pass a video as --video"


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()


def _has(path: Path, form: str | None) -> bool:
    """Whether a file has a text by which those of convert.py are known."""
    return form is not None and path.is_file() and form in path.read_text(encoding="utf-8", errors="replace")


def refuse_foreign_results(layout: Layout, scene_made: bool, work_made: bool, skip_matching: bool) -> None:
    """Raise UserError if writing would overwrite a scene or a COLMAP project that convert.py did not make.

    scene_made, work_made: whether an earlier run here began to write the scene, or into the work folder.
    """
    forms = dict.fromkeys((layout.images, layout.sparse, layout.orientation))
    forms |= {layout.report: '"left_out"', layout.page: "<title>Capture: "}
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
