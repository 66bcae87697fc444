"""Fixtures that several test files share."""

import os
import re
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import groundwork.host.openmp  # noqa: F401  isort: skip  (before torch)
import pytest
import torch
from filelock import FileLock
from synthetic import make_blender_scene, make_colmap_scene

from splatting.records import curve_recorder
from splatting.records.error_curve import FIGURE

# Tests run side by side, a process a core. Those about several threads set their number.
os.environ.setdefault("OMP_NUM_THREADS", "1")  # of programs that a test starts
torch.set_num_threads(1)


ROOT = Path(__file__).resolve().parent
_OF_COMMAND = {name: name for name in ("convert", "doctor", "export")} | {"full_eval": "evaluation", "view": "viewer"}
_USED = re.compile(rf"^(?:from|import) (applications\.\w+|benchmarks|{'|'.join(_OF_COMMAND)})\b", re.MULTILINE)


def _list_rooms(path: Path) -> set[str]:
    """The applications, and benchmarks, that a test imports, also by helpers of tests."""
    found, files, seen = set(), [path], set()
    while files:
        text = (file := files.pop()).read_text(encoding="utf-8")
        seen.add(file)
        found |= {f"applications.{_OF_COMMAND[name]}" if name in _OF_COMMAND else name for name in _USED.findall(text)}
        helpers = {ROOT / "tests" / f"{name}.py" for name in re.findall(r"(?m)^from (\w+) import", text)}
        files += [helper for helper in helpers - seen if helper.is_file()]
    return found


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Leave out a test that imports an application or benchmarks, if that folder was deleted.

    GS_TESTS=applications, which `make check-applications` sets, leaves out the tests that import neither.
    """
    if collection_path.suffix != ".py":
        return None
    rooms = _list_rooms(collection_path)
    deleted = any(not ROOT.joinpath(*room.split(".")).is_dir() for room in rooms)
    of_core = not rooms and ROOT / "tests" in collection_path.parents
    return True if deleted or (of_core and os.environ.get("GS_TESTS") == "applications") else None


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """Folder with real scenes and models: $GS_SHARED, or `shared` beside the repository; skips if it is missing."""
    folder = Path(os.environ.get("GS_SHARED") or Path(__file__).resolve().parents[1] / "shared")
    if not (folder / "scenes").is_dir():
        pytest.skip(f"no real scenes in {folder}; set GS_SHARED")
    return folder


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Tests without the mark `gpu` are of the CPU: also on a machine that has a GPU, their trainings see none."""
    with pytest.MonkeyPatch.context() as patch:
        if item.get_closest_marker("gpu") is None:
            patch.setenv("CUDA_VISIBLE_DEVICES", "")  # for programs that the test starts
            patch.setattr(torch.cuda, "is_available", lambda: False)
            patch.setattr(torch.cuda, "_cached_device_count", 0, raising=False)  # torch remembers what it saw first
        return (yield)


@pytest.fixture(scope="session", autouse=True)
def cache_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A separate cache folder for the tests, used by subprocesses too."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GS_CACHE", str(folder))
        yield folder


@pytest.fixture(scope="session", autouse=True)
def hangups() -> None:
    """Programs under test see SIGHUP, also where the tests themselves run under nohup."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


class Undrawn(curve_recorder.CurveDrawer):
    """Writes an empty picture: a process that draws takes a core 1.5 s, and most trainings are about something else."""

    def begin(self) -> None: ...

    def draw(self) -> None:
        (self._folder / FIGURE).touch()

    def finish(self) -> None: ...


@pytest.fixture(scope="session", autouse=True)
def undrawn() -> Iterator[None]:
    """Trainings in the process of a test draw no curve."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(curve_recorder, "CurveDrawer", Undrawn)
        yield


@pytest.fixture(autouse=True)
def stdout() -> Iterator[None]:
    """Restore stdout after each test: training stamps it, and may silence it."""
    before = sys.stdout
    yield
    sys.stdout = before


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], object]], Path]:
    """A function that lets make(folder) fill a folder once, and names it. Tests of all workers read it."""
    base = tmp_path_factory.getbasetemp()
    shared = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "once"

    def made(name: str, make: Callable[[Path], object]) -> Path:
        """Make the folder `name` with `make`, once for all test processes, and return its path."""
        folder, done = shared / name, shared / f"{name}.done"
        folder.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(shared / f"{name}.lock"):
            if not done.exists():
                make(folder)
                done.touch()
        return folder

    return made


@pytest.fixture(scope="session")
def _colmap_master(once) -> Path:
    return once("colmap_scene", make_colmap_scene)


@pytest.fixture(scope="session")
def _blender_master(once) -> Path:
    return once("blender_scene", make_blender_scene)


@pytest.fixture
def colmap_scene(_colmap_master: Path, tmp_path: Path) -> Path:
    """A COLMAP scene of 17 photos, 96x64, PINHOLE with an off-centre principal point; a copy that tests may change."""
    return Path(shutil.copytree(_colmap_master, tmp_path / "colmap_scene"))


@pytest.fixture
def blender_scene(_blender_master: Path, tmp_path: Path) -> Path:
    """A Blender scene of 4 training and 2 test frames, 40x30 RGBA; a copy that tests may change."""
    return Path(shutil.copytree(_blender_master, tmp_path / "blender_scene"))


@pytest.fixture
def threads() -> Iterator[Callable[[int], None]]:
    """A function that sets torch's number of threads for this test."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.fixture
def dtype(request: pytest.FixtureRequest) -> Iterator[torch.dtype]:
    """The dtype of a parameter (device, dtype); the device is torch's default during the test."""
    device, made = request.param
    with torch.device(device):
        yield made
