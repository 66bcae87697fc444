"""COLMAP as convert.py uses it: the commands of its long steps, and queries of its database, also while it writes.

The commands are those of pycolmap (worker.py), or those of a COLMAP program that the user names.
"""

import contextlib
import json
import sqlite3
import subprocess
import sys
from collections import Counter
from collections.abc import Collection
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from diff_gaussian_rasterization.lens import MODELS

from applications.convert.layout import Layout
from groundwork.host.programs import find_program
from utils.system_utils import UserError, atomic_write

Command = list[str]
TOLERANCE = 1e-6  # of the cost in global bundle adjustment, as in the reference: much faster, hardly worse
ALL_PAIRS = 60  # photos of which --matcher auto matches every pair
GIVEN = "triangulation"  # the mapper where poses are given
ADDING = "adding"  # the mapper that keeps the poses of a scene
PANORAMA = "EQUIRECTANGULAR"  # photos of all directions, twice as wide as high; no pinhole image shows them
LENS_MODELS = (
    PANORAMA,
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "FOV"),
    *("SIMPLE_DIVISION", "DIVISION", "SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"),
    *("OPENCV_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE", "EUCM"),
)
# Fisheyes and panoramas, which see too much for a pinhole image, and through which train.py shows Gaussians.
_WIDE = {model for model, (chart, *_) in MODELS.items() if chart != "perspective"}
_WORKER = Path(__file__).with_name("worker.py")
_GLOBAL = "view_graph_calibrator", "global_mapper"  # commands that older versions of COLMAP lack
_PAIR = 2147483647  # COLMAP: pair_id = smaller image_id * this + larger image_id


@dataclass(frozen=True)
class Settings:
    """The user's choices.

    camera: COLMAP's name of the lens model to fit. cameras: what shares one (cameras.MODES). lenses: native, undistort
    or auto. matcher: exhaustive, sequential or auto. mapper: global, incremental, auto, GIVEN or ADDING.
    """

    camera: str
    max_num_features: int
    matcher: str
    mapper: str
    no_gpu: bool
    cameras: str = "per_lens"
    lenses: str = "auto"


def worker_command(layout: Layout, step: str, **job: Any) -> Command:
    """Return the command for one step of worker.py. The job is passed in a file, since there can be many images."""
    path = layout.work / "jobs" / f"{step}.json"
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps({"step": step, **job}), encoding="utf-8")
    return [sys.executable, str(_WORKER), str(path)]


def is_native(lenses: str, models: Collection[str]) -> bool:
    """Tell if photos stay as they are, by --lenses and the camera models. UserError for panoramas to undistort."""
    if lenses == "undistort" and PANORAMA in models:
        raise UserError("no pinhole image shows a panorama; omit --lenses undistort")
    return lenses == "native" or (lenses == "auto" and not _WIDE.isdisjoint(models))


class Backend:
    """Makes the commands that compute features, matches and models, a list for each step.

    identity: program and version. Results of another program or version are not resumed.
    groups: lists of names; the images of a list have one size and share a camera.
    """

    identity: str
    ways: tuple[str, ...]  # of mapping, in the order in which they are tried until a model agrees with its pairs

    def __init__(self, layout: Layout, settings: Settings) -> None:
        self.layout, self.settings = layout, settings
        self.ways = ("global", "incremental") if settings.mapper == "auto" else (settings.mapper,)

    def calibration(self) -> list[Command]:
        """Commands that write focal lengths into `layout.calibrated`, a copy of the database."""
        return [worker_command(self.layout, "calibrate", calibrated=str(self.layout.calibrated))]


class Pycolmap(Backend):
    """The pycolmap package, which the project requires anyway."""

    def __init__(self, layout: Layout, settings: Settings) -> None:
        super().__init__(layout, settings)
        self.identity = f"pycolmap {version('pycolmap')}"
        if settings.mapper == "auto":
            self.ways = ("direct", "grown", "global", "incremental", "free")

    def features(self, groups: list[list[str]], masks: bool) -> list[Command]:
        return self._make_commands("features", groups=groups, masks=str(self.layout.masks) if masks else "")

    def matching(self) -> list[Command]:
        return self._make_commands("matching", all_of=ALL_PAIRS)

    def mapping(self, way: str, models: Path, **job: Any) -> list[Command]:
        step = way if way in (GIVEN, ADDING) else "mapping"
        places = {"models": str(models), "calibrated": str(self.layout.calibrated), **job}
        return self._make_commands(step, mapper=way, tolerance=TOLERANCE, **places)

    def _make_commands(self, step: str, **job: Any) -> list[Command]:
        """Return the command of a step of worker.py.

        job: entries of the job file that replace or extend the settings and the paths of the layout.
        """
        places = {
            "database": self.layout.database,
            "images": self.layout.prepared,
            "small": self.layout.small,
            "models": self.layout.models,
        }
        places |= {"given": self.layout.given, "base": self.layout.base_model}
        common = {**asdict(self.settings), **{name: str(path) for name, path in places.items()}}
        return [worker_command(self.layout, step, **{**common, **job})]


class Program(Backend):
    """A COLMAP program, which the user names.

    Before any step runs, its own help gives the names of options that differ between versions.
    UserError if it cannot be run, is not COLMAP, or lacks a command that the settings need.
    """

    def __init__(self, executable: str, layout: Layout, settings: Settings) -> None:
        """Ask the program for its version and its options. UserError if it cannot do what the settings need.

        executable: name or path of the program.
        """
        super().__init__(layout, settings)
        self._executable = find_program(executable)
        if self._executable is None:
            raise UserError(
                f"there is no {executable} on PATH; pass the path of COLMAP as --colmap_executable, or omit the option "
                "to use pycolmap"
            )
        named = [line for line in (self._read_output("help") or "").splitlines() if line.startswith("COLMAP")]
        if not named:
            raise UserError(
                f"{executable} does not answer `help` as COLMAP does; pass the path of COLMAP as --colmap_executable, "
                "or omit the option to use pycolmap"
            )
        self.identity = named[0]
        self._matcher = f"{'exhaustive' if settings.matcher == 'auto' else settings.matcher}_matcher"
        switch = "0" if settings.no_gpu else "1"
        # COLMAP 3.12 renamed these options when it got features other than SIFT.
        self._gpu_for_features = [self._find_option("feature_extractor", "Extraction.use_gpu"), switch]
        self._gpu_for_matching = [self._find_option(self._matcher, "Matching.use_gpu"), switch]
        self._maps_globally = all(self._read_output(name, "-h") is not None for name in _GLOBAL)
        if settings.mapper == "global" and not self._maps_globally:
            raise UserError(
                f"{executable} ({self.identity}) has no global_mapper; use --mapper incremental, or omit "
                "--colmap_executable to use pycolmap's global mapper"
            )
        if settings.mapper == "auto" and not self._maps_globally:
            self.ways = ("incremental",)

    def features(self, groups: list[list[str]], masks: bool) -> list[Command]:
        """Return the commands that write SIFT features into the database: one for each group of photos.

        groups: names of the photos that share a camera, group by group.
        masks: true if the photos have masks.
        """
        commands = []
        mode = "single_camera"
        if all(len(names) == 1 for names in groups):  # one command does, instead of one for each photo
            groups, mode = [[name for names in groups for name in names]], "single_camera_per_image"
        for number, names in enumerate(groups):
            listed = self.layout.work / "jobs" / f"photos_{number}.txt"
            with atomic_write(listed) as temporary:
                temporary.write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
            command = [
                *self._begin_command("feature_extractor", self.layout.database),
                *("--image_path", str(self.layout.prepared)),
                *("--image_list_path", str(listed)),
                *("--ImageReader.camera_model", self.settings.camera),
                *(f"--ImageReader.{mode}", "1"),
                *("--SiftExtraction.max_num_features", str(self.settings.max_num_features)),
            ]
            command += ["--ImageReader.mask_path", str(self.layout.masks)] if masks else []
            commands.append(command + self._gpu_for_features)
        return commands

    def matching(self) -> list[Command]:
        return [self._begin_command(self._matcher, self.layout.database) + self._gpu_for_matching]

    def calibration(self) -> list[Command]:
        calibrator, _ = _GLOBAL
        return (
            [self._begin_command(calibrator, self.layout.calibrated)] if self._maps_globally else super().calibration()
        )

    def mapping(self, way: str, models: Path) -> list[Command]:
        """Return the command that maps the photos.

        way: "global" or "incremental".
        models: folder to make, which gets one sub-folder per model.
        """
        models.mkdir(parents=True)
        paths = ["--image_path", str(self.layout.prepared), "--output_path", str(models)]
        if way == "global":
            return [[*self._begin_command(_GLOBAL[1], self.layout.calibrated), *paths]]
        started = self._begin_command("mapper", self.layout.database)
        return [[*started, *paths, "--Mapper.ba_global_function_tolerance", str(TOLERANCE)]]

    def _begin_command(self, name: str, database: Path) -> Command:
        return [self._executable, name, "--database_path", str(database)]

    def _find_option(self, name: str, option: str) -> str:
        """Return an option of features or of SIFT, as the help of a command lists it. UserError if it lists none."""
        options = f"--Feature{option}", f"--Sift{option}"
        text = self._read_output(name, "-h") or ""
        for known in options:
            if known in text:
                return known
        raise UserError(
            f"`{self._executable} {name} -h` lists neither {' nor '.join(options)}, so this version of COLMAP is not "
            "supported; omit --colmap_executable to use pycolmap"
        )

    def _read_output(self, *arguments: str) -> str | None:
        """Return the program's output; None if it fails."""
        command = [self._executable, *arguments]
        try:
            done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=60)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise UserError(
                f"cannot run --colmap_executable {self._executable} ({error}); pass its full path, or omit the option "
                "to use pycolmap"
            ) from error
        return done.stdout + done.stderr if done.returncode == 0 else None


def count_rows(database: Path, table: str) -> int:
    """Count the rows of a table; 0 while it does not exist or is locked."""
    rows = _query_database(database, f"SELECT COUNT(*) FROM {table}")
    return rows[0][0] if rows else 0


def list_photos(database: Path) -> list[str]:
    """List the photos of a database, sorted."""
    return sorted(name for (name,) in _query_database(database, "SELECT name FROM images"))


def count_most_features(database: Path) -> int:
    """Return the largest number of features of a photo."""
    rows = _query_database(database, "SELECT MAX(rows) FROM keypoints")
    return (rows[0][0] or 0) if rows else 0


def forget_matches(database: Path) -> None:
    """Empty the tables that matching fills; keep the features."""
    if not database.is_file():
        return
    # A database that was interrupted before it had tables has no matches.
    with contextlib.suppress(sqlite3.OperationalError), contextlib.closing(sqlite3.connect(database)) as connection:
        connection.execute("DELETE FROM matches")
        connection.execute("DELETE FROM two_view_geometries")
        connection.commit()


def copy_database(database: Path, target: Path) -> None:
    """Copy a database, including changes that are still in its log."""
    target.unlink(missing_ok=True)
    with contextlib.closing(sqlite3.connect(database)) as source, contextlib.closing(sqlite3.connect(target)) as copy:
        source.backup(copy)


def count_partners(database: Path) -> dict[str, int]:
    """Count, for every photo, the other photos with which its matches passed the geometric check."""
    names = dict(_query_database(database, "SELECT image_id, name FROM images"))
    counts = Counter({name: 0 for name in names.values()})
    for (pair,) in _query_database(database, "SELECT pair_id FROM two_view_geometries WHERE rows > 0"):
        for image in divmod(pair, _PAIR):
            if image in names:
                counts[names[image]] += 1
    return dict(counts)


def _query_database(database: Path, statement: str) -> list[tuple]:
    """Return the rows that an SQL statement selects; none while the database is missing, locked or without tables."""
    if not database.is_file():
        return []
    with contextlib.suppress(sqlite3.Error):
        connection = sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True, timeout=1)
        with contextlib.closing(connection):
            return connection.execute(statement).fetchall()
    return []
