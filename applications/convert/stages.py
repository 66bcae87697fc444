"""Stages of a conversion, each with its inputs and the way to undo it, and the record of finished ones.

A second run does only the rest.
"""

import argparse
import contextlib
import hashlib
import json
import re
import shutil
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from applications.convert import cameras, colmap, images, report, video
from applications.convert.adding import read_base_state
from applications.convert.checks import check_given_poses, check_reconstruction, check_shared_cameras, refuse_unplaced
from applications.convert.colmap import Backend, Settings, worker_command
from applications.convert.dense_points import add_points
from applications.convert.given_poses import find_posed_photos, list_given, list_pose_files, write_given
from applications.convert.layout import Layout, image_names
from applications.convert.mapping import map_photos
from applications.convert.orienting import orient_scene
from applications.convert.programs import run_programs
from groundwork.files.json_files import read_json, write_json
from scene.checks.conversion import file_state
from utils.system_utils import UserError, mkdir_p

FACTORS = (2, 4, 8)  # of --resize
# Distances, in the order of names, of the pairs of COLMAP's sequential matching: 1 to 10, and 2^0 to 2^9.
_NEIGHBOURS = sorted({*range(1, 11), *(2**k for k in range(10))})
_USUAL = 14  # pairs that --matcher auto finds for a photo of many
# Seconds of all later stages, by those of one: of 292 photos of 800 pixels on two cores.
_LATER = {"Features": 4.3, "Matching": 1.9}
_REGISTERED = re.compile(rb"num_reg_frames=(\d+)|Registering image #\d+ \((\d+)\)")


class Stage(NamedTuple):
    """One step of a conversion.

    made_from: JSON of everything that its result depends on, besides the earlier stages. reset: removes results that
    become invalid when this or an earlier stage is done again. check: raises UserError for unusable inputs, before
    anything is removed. resumable: `work` can resume an interrupted run with the same inputs, without a reset.
    makes: what is in the scene once it is done; if that was removed, the stage is done again.
    """

    name: str
    made_from: Any
    reset: Callable[[], None]
    work: Callable[[], None]
    resumable: bool = False
    check: Callable[[], None] = lambda: None
    makes: Sequence[Path] = ()


class StageRecord:
    """The file stages.json. It has, for each stage begun, a digest of its inputs and whether it was finished.

    Notes lie beside them: the options and the photos of the last conversion that began a stage.
    """

    def __init__(self, path: Path) -> None:
        """Read the record of an earlier run, if there is one. UserError if that is damaged."""
        self._path = path
        self._record: dict[str, dict[str, Any]] = {}
        if path.is_file():
            try:
                self._record = read_json(path)
                _ = [(entry["done"], entry["made_from"]) for entry in self._record.values()]
            except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
                message = f"{path} is damaged; remove the folder {path.parent} to convert from the beginning"
                raise UserError(message) from error

    def note(self, name: str, content: Any) -> None:
        """Write a note, once a stage begins."""
        self._record[name] = {"made_from": content, "done": True}

    def begun(self, name: str) -> bool:
        """Tell if a stage was ever begun in this folder."""
        return name in self._record

    def finished(self, name: str) -> bool:
        """Tell if a stage was finished."""
        return self.begun(name) and self._record[name]["done"]

    def interrupted(self, name: str) -> bool:
        """Tell if a stage was begun and not finished."""
        return self.begun(name) and not self.finished(name)

    def run(self, stages: list[Stage]) -> list[str]:
        """Do the stages that are not done, in order; return the names of those that were done before.

        The first stage whose inputs changed or that was never finished is done again, with all later ones.
        """
        digest, kept = "", []
        for number, stage in enumerate(stages):
            text = json.dumps([digest, stage.name, stage.made_from], sort_keys=True)
            digest = hashlib.sha256(text.encode()).hexdigest()[:16]
            before = self._record.get(stage.name, {})
            same = before.get("made_from") == digest
            if same and before["done"] and all(path.exists() for path in stage.makes):
                kept.append(stage.name)
                continue
            stage.check()
            for later in stages[number:]:
                if later.name in self._record:
                    self._record[later.name]["done"] = False  # but still begun: remaining files of it are ours
            self._save()
            # Reset backwards, so that the newest results go first.
            for later in reversed(stages[number:]):
                if later is not stage or not (same and stage.resumable):
                    later.reset()
            self._record[stage.name] = {"made_from": digest, "done": False}
            self._save()
            start = time.monotonic()
            stage.work()
            self._record[stage.name] |= {"done": True, "seconds": round(time.monotonic() - start, 1)}
            self._save()
        return kept

    def seconds(self) -> dict[str, float]:
        """Return the seconds that each finished stage took when it was last done, in order."""
        return {name: entry["seconds"] for name, entry in self._record.items() if "seconds" in entry and entry["done"]}

    def _save(self) -> None:
        write_json(self._path, self._record)


def video_stage(layout: Layout, videos: Sequence[Path], count: int) -> Stage:
    """Make the stage that writes frames of videos into `input`."""

    def check() -> None:
        video.find_decoder()
        video.refuse_foreign_frames(layout, videos)

    return Stage(
        "video",
        [[file_state(path) for path in videos], count],
        reset=partial(video.remove_frames, layout),
        work=partial(video.extract_videos, layout, videos, count),
        check=check,
    )


def image_stage(layout: Layout, names: list[str], masks: Path | None) -> Stage:
    """Make the stage that puts upright photos and masks into the work folder."""
    made_from = [[name, file_state(layout.input / name)] for name in names]
    if masks:
        made_from.append([[str(path), file_state(path)] for path in sorted(masks.rglob("*")) if path.is_file()])

    return Stage(
        "photos",
        made_from,
        reset=lambda: _remove_paths(layout.prepared, layout.masks),
        work=lambda: images.prepare_images(layout, names, masks),
        check=lambda: images.check_images(layout, names, masks),
    )


def poses_stage(layout: Layout, source: Path) -> Stage:
    """Make the stage that finds the given poses and cameras of the photos."""
    return Stage(
        "poses",
        [[str(path), file_state(path)] for path in list_pose_files(source)],
        reset=lambda: _remove_paths(layout.given),
        work=lambda: write_given(layout, source),
        check=lambda: find_posed_photos(layout, source) and None,
    )


def reconstruction_stages(backend: Backend, masks: bool) -> list[Stage]:
    """Make the stages features, matching and mapping."""
    layout, settings = backend.layout, backend.settings
    hint = "" if settings.no_gpu else "; --no_gpu may help if the GPU or the display is the reason"

    rows = partial(colmap.count_rows, layout.database)

    def run(commands: list[colmap.Command], title: str, total: int, done: Callable[[], int], hint: str = "") -> None:
        run_programs(layout.log, commands, title, total, done, hint, _LATER.get(title, 0.0))

    def features() -> None:
        """Write features of all photos into the database."""
        if settings.mapper == colmap.GIVEN:
            names = [list_given(layout)]
        else:
            groups = cameras.group_photos(layout.prepared, image_names(layout.prepared), settings.cameras)
            print(cameras.describe_groups(groups))
            names = [group.names for group in groups]
        if settings.mapper == colmap.ADDING:
            colmap.copy_database(layout.base_database, layout.database)
        run(backend.features(names, masks), "Features", sum(map(len, names)), partial(rows, "keypoints"), hint)

    def matching() -> None:
        """Match pairs of photos in the database."""
        count = rows("images")
        usual = range(1, count if count <= colmap.ALL_PAIRS else _USUAL)
        steps = {"sequential": _NEIGHBOURS, "auto": usual}.get(settings.matcher, range(1, count))
        pairs = sum(max(count - step, 0) for step in steps)
        run(backend.matching(), "Matching", pairs, partial(rows, "matches"), hint)

    def mapping() -> None:
        def place(title: str, commands: list[colmap.Command]) -> None:
            run(commands, title, rows("images"), _make_registered_counter(layout.log))

        map_photos(backend, lambda commands, title: run(commands, title, 1, lambda: 0), place)

    def check_sizes() -> None:
        """UserError for photos that are no panoramas, if they are said to be."""
        wrong = [names[0] for (w, h), names in images.group_by_size(layout).items() if w != 2 * h]
        if settings.camera == colmap.PANORAMA and wrong:
            raise UserError(
                f"{wrong[0]} is not twice as wide as high, as panoramas of 360 by 180 degrees are; remove such photos, "
                "or name the lens that took them with --camera"
            )

    mapped = layout.models, layout.tried, layout.judged, layout.calibrated, layout.calibrated.with_suffix(".npz")
    files = [layout.database.with_name(layout.database.name + end) for end in ("", "-wal", "-shm", "-journal")]
    features_from = [backend.identity, settings.camera, settings.cameras, settings.max_num_features, settings.no_gpu]
    if settings.mapper == colmap.ADDING:
        features_from.append(read_base_state(layout))
    return [
        Stage("features", features_from, lambda: _remove_paths(*files, layout.small), features, check=check_sizes),
        Stage("matching", [settings.matcher], lambda: colmap.forget_matches(layout.database), matching, resumable=True),
        Stage("mapping", [settings.mapper], lambda: _remove_paths(*mapped), mapping),
    ]


def undistortion_stage(layout: Layout, settings: Settings, record: StageRecord, made_from: Any, **made: Any) -> Stage:
    """Make the stage that writes the largest model and its photos to `images` and `sparse/0`, and the report.

    record: of the stages, by which outputs of an earlier run are known. The scene of that run stays until the new one
    is complete.
    made_from: state of a model made elsewhere (--skip_matching), else None.
    made: further entries of the report, such as settings.
    """

    def write_scene() -> None:
        """Write photos, model and report in the work folder, then put them in place of those of an earlier run."""
        root = layout.prepared if layout.prepared.is_dir() else layout.input
        _survey_models(layout, root)
        tried = report.read_tried(layout) if made_from is None else []  # else a model was made elsewhere
        models = report.read_survey(layout, tried)
        names = image_names(root)
        matches = colmap.count_partners(layout.database)
        refuse_unplaced(models, names, matches, settings.matcher)
        chosen, lenses, limit = models[0], cameras.read_lenses(root, names), settings.max_num_features
        at_limit = limit if colmap.count_most_features(layout.database) >= limit else 0
        given = settings.mapper == colmap.GIVEN
        found = [*check_given_poses(chosen, names)] if given else []  # UserError before anything is replaced
        native = colmap.is_native(settings.lenses, {camera["model"] for camera in chosen.cameras})
        _write_photos(layout, root, chosen, native)
        shared = {name: photo["shared"] for name, photo in read_json(layout.capture)["photos"].items()}
        # Patches could lie where masks leave photos out.
        more = 0 if layout.masks.is_dir() else add_points(layout.undistorted, shared, settings.no_gpu)
        masks = {name: layout.masks / f"{name}.png" for name in names}
        if same := images.find_shared_pixels(root, names, masks, layout.input):  # which other weaknesses come from
            found += same
        elif not given:
            found += check_reconstruction(
                models, names, matches, settings.matcher, at_limit, tried, more, settings.cameras
            )
            found += check_shared_cameras(chosen.cameras, lenses, settings.cameras, video.list_taken_frames(layout))
        later = [path for name, paths in _list_outputs(layout).items() if record.begun(name) for path in paths]
        made_of = {**made, "advice": [*map(str, found)], "cameras": cameras.describe_cameras(chosen.cameras, lenses)}
        made_of |= {"lenses": "native" if native else "undistort", "more_points": more, "tried": tried}
        _replace_scene(layout, later, partial(report.write_report, layout.report, models, names, matches, **made_of))

    reset, makes = partial(_remove_paths, layout.undistorted), [layout.images, layout.report, layout.sparse / "0"]
    return Stage("undistortion", [made_from, settings.lenses], reset, write_scene, makes=makes)


def _survey_models(layout: Layout, root: Path) -> None:
    """Write survey.json: what the mapper's models contain. root: folder of the photos."""
    places = {"models": str(layout.models), "images": str(root), "out": str(layout.survey)}
    survey = worker_command(layout, "survey", **places)
    run_programs(layout.log, [survey], "Reading models", 1, layout.survey.exists)


def _write_photos(layout: Layout, root: Path, chosen: report.Model, native: bool) -> None:
    """Write the chosen model, its photos and capture.json into the work folder. UserError for missing photos.

    root: folder of the photos.
    native: true if they stay as they are; else they are undistorted.
    """
    paths = {"model": layout.models / chosen.folder, "images": root, "out": layout.undistorted}
    job = {name: str(path) for name, path in (paths | {"capture": layout.capture}).items()}
    command = worker_command(layout, "undistort", **job, native=native, jpeg_quality=images.JPEG_QUALITY)
    written = layout.undistorted / "images"
    count, title = len(chosen.registered), "Copying photos" if native else "Undistorting"
    run_programs(layout.log, [command], title, count, lambda: sum(p.is_file() for p in written.rglob("*")))
    missing = [name for name in chosen.registered if not (written / name).is_file()]
    if missing:
        raise UserError(
            f"{len(missing)} photos of the model in {layout.models / chosen.folder} are not in {root}, the first "
            f"is {missing[0]}; put them there under the names that they have in the model"
        )


def _replace_scene(layout: Layout, later: Sequence[Path], write_report: Callable[[], None]) -> None:
    """Put photos and model of the work folder in the place of the scene's, and write the report.

    later: outputs of the stages after this one, which become invalid.
    """
    whole = layout.undistorted / "whole"
    mkdir_p(whole)
    (layout.undistorted / "sparse").rename(whole / "0")
    # `sparse` goes first and comes last: what has one has the photos, too, and the report on whether to train on them.
    _remove_paths(layout.sparse, layout.images, layout.report, *later)
    (layout.undistorted / "images").rename(layout.images)
    write_report()
    whole.rename(layout.sparse)
    _remove_paths(layout.undistorted)


def resize_stage(layout: Layout) -> Stage:
    """Make the stage that writes smaller copies of the photos: images_2, images_4, images_8."""

    def write_copies() -> None:
        for factor in FACTORS:
            _remove_paths(layout.resized(factor))
            images.resize_images(layout, factor)

    # No reset: undistortion removes the copies when it replaces the photos that they were made from.
    return Stage("resize", list(FACTORS), lambda: None, write_copies)


def requested_stages(layout: Layout, record: StageRecord, args: argparse.Namespace) -> list[Stage]:
    """Make the optional stages, the last ones, that a user asks for, or with --add has asked for before.

    UserError for files that these stages would replace, if no earlier run wrote the files.
    """
    last = resize_stage(layout), orient_stage(layout)
    wanted = [stage for stage in last if getattr(args, stage.name) or (args.add and record.begun(stage.name))]
    for name in (stage.name for stage in wanted if not record.begun(stage.name)):
        if there := [path for path in _list_outputs(layout)[name] if path.exists()]:
            raise UserError(f"convert.py did not make {there[0]}, and --{name} would replace it; move it away")
    return wanted


def _list_outputs(layout: Layout) -> dict[str, list[Path]]:
    """Return the paths that the optional stages write into the scene, by the stages' names."""
    return {"resize": [*map(layout.resized, FACTORS)], "orient": [layout.orientation]}


def orient_stage(layout: Layout) -> Stage:
    """Make the stage that finds where the scene is upright."""
    return Stage("orient", 1, lambda: _remove_paths(layout.orientation), lambda: orient_scene(layout))


def read_model_state(layout: Layout) -> list[Any]:
    """Describe the files of a model made elsewhere, so that changes show. UserError if there is no model."""
    files = sorted(layout.models.rglob("*.*")) if layout.models.is_dir() else []
    if not files:
        raise UserError(f"--skip_matching needs a COLMAP model in {layout.models}; omit the option to make one")
    return [[str(path.relative_to(layout.models)), *file_state(path)] for path in files]


def _make_registered_counter(log: Path) -> Callable[[], int]:
    """Make a function that counts the photos placed since now.

    log: COLMAP's log. Each call reads on where the one before stopped, and returns the largest count that the mapper
    has
    written there so far.
    """
    position = log.stat().st_size if log.is_file() else 0
    most = 0

    def count() -> int:
        nonlocal position, most
        with contextlib.suppress(OSError), open(log, "rb") as file:
            file.seek(position)
            text = file.read()
            # Leave an incomplete line for the next call.
            whole = text[: text.rfind(b"\n") + 1]
            position += len(whole)
            for match in _REGISTERED.finditer(whole):
                most = max(most, int(match[1] or match[2]) + 1)
        return most

    return count


def _remove_paths(*paths: Path) -> None:
    """Remove files, links and whole folders, where they exist."""
    for path in paths:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
