"""Rules of parts (splatting/part.py): each can be deleted, and two do not fill the same slot."""

import subprocess
import sys
from pathlib import Path

import pytest
from forks import fork
from synthetic import make_colmap_scene

from arguments.features import FEATURES, appearances, strategies
from splatting.part import Appearance, Part, Strategy
from splatting.registry import PARTS, states_in
from splatting.run import overrides
from utils.system_utils import UserError

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("applications", "arguments", "gaussian_renderer", "groundwork", "scene", "splatting", "utils")
CLASSES = {part.name: part for part in PARTS}
NAMES = [*CLASSES]
COMMANDS = ("train", "render", "metrics", "full_eval", "convert", "doctor", "export", "view")


def _options(name: str) -> set[str]:
    return {*FEATURES[name].by_name} if name in FEATURES else set()


def _heirs(name: str) -> list[str]:
    """The parts that inherit from a part, as strategies may."""
    return [other for other in NAMES if other != name and issubclass(CLASSES[other], CLASSES[name])]


def test_options_import_nothing_heavy_and_no_part():
    """doctor.py reads options where torch is missing."""
    code = "import sys, arguments.launch; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert not {"torch", "numpy", "scene", "splatting"} & {*done.stdout.split()}


def test_parts_import_no_options_which_another_package_may_hide():
    """Other people's code with a package `arguments` of its own calls `Scene`."""
    done = fork("import sys; sys.modules['arguments'] = None; import splatting.registry")
    assert done.status == 0, done.stderr


def test_the_table_of_options_has_parts_in_their_order_and_what_they_are():
    assert [name for name in FEATURES if name in NAMES] == [name for name in NAMES if name in FEATURES]
    assert [*strategies()] == [part.name for part in PARTS if issubclass(part, Strategy)]
    flags = {part.kind: part.flag for part in PARTS if issubclass(part, Appearance)}
    assert {one.name: one.flag for one in appearances()} == flags


# A program in which some parts are not there: neither their lines of the registry, their options nor their files.
WITHOUT = """
import sys
from functools import partial
from pathlib import Path
sys.path.append("tests")
from other_sources import PLACES, edit, without
hidden, *words = sys.argv[1:]
hidden = hidden.split(",")
edit(dict.fromkeys(PLACES, partial(without, hidden=hidden)))
files = [path for name in hidden for path in Path("splatting/features").glob(f"{name}*.py")]
sys.modules |= {f"splatting.features.{path.stem}": None for path in files}
"""
IMPORTED = """
from importlib import import_module
left_out = "applications.nerfbaselines", *(f"splatting.features.{name}" for name in hidden)
for room in words:
    paths = [p for p in Path(room).rglob("*.py") if "tests" not in p.parts] if Path(room).is_dir() else [Path(room)]
    for path in sorted(paths):
        module = ".".join(path.with_suffix("").parts).removesuffix(".__init__")
        if not module.endswith("__main__") and not module.startswith(left_out):
            import_module(module)
from arguments import OPTIONS
from arguments.launch import launch_options
print(*(option.name for option in OPTIONS), *vars(launch_options()))
"""


def _halves() -> list[list[str]]:
    """Halves of the parts, so that for any two of them one half lacks the first and has the second, unless it inherits.

    What inherits from a part goes with it.
    """
    digits = range((len(NAMES) - 1).bit_length())
    halves = [{name for n, name in enumerate(NAMES) if n >> digit & 1 == bit} for digit in digits for bit in (0, 1)]
    return [[name for name in NAMES if name in half or any(name in _heirs(one) for one in half)] for half in halves]


@pytest.mark.parametrize("hidden", _halves())
def test_without_half_of_the_parts_all_else_imports_and_lacks_their_options_alone(hidden):
    done = fork(WITHOUT + IMPORTED, ",".join(hidden), *ROOMS, *(f"{command}.py" for command in COMMANDS))
    assert done.status == 0, done.stderr
    there, gone = {*done.stdout.split()}, {option for name in hidden for option in _options(name)}
    assert not there & gone and {option for name in NAMES for option in _options(name)} - gone <= there


TRAINED = """
import doctor, export, render, train
scene, out, strategy = words
short = ["--strategy", strategy, "--iterations", "20", "--test_iterations", "20", "--eval", "-r", "48"]
train.main(["-s", scene, "-m", out, "--disable_viewer", *short])
for command, line in ((render, ["-m", out]), (doctor, ["-m", out]), (export, ["-m", out, "--to", out + "/a.ply"])):
    sys.argv = [command.__name__, *line]
    try:
        command.main()
    except SystemExit as ended:
        assert not ended.code or command is doctor
"""


@pytest.fixture(scope="module")
def scene(once) -> Path:
    return once("scene_of_parts", make_colmap_scene)


def _trained(scene: Path, out: Path, strategy: str, hidden: str) -> bytes:
    done = fork(WITHOUT + TRAINED, hidden, str(scene), str(out), strategy)
    assert done.status == 0, done.stderr
    return (out / "point_cloud/iteration_20/point_cloud.ply").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [half for half in _halves() if not {*strategies()} <= {*half}])
def test_without_half_of_the_parts_a_training_has_the_bytes_of_one_with_them_off(hidden, scene, tmp_path, once):
    strategy = next(name for name in strategies() if name not in hidden)
    whole = once(f"of_all_parts_by_{strategy}", lambda folder: _trained(scene, folder, strategy, "none"))
    ply = whole / "point_cloud/iteration_20/point_cloud.ply"
    assert _trained(scene, tmp_path / "out", strategy, ",".join(hidden)) == ply.read_bytes()


@pytest.mark.parametrize(("key", "name"), [("keep_best", "keep_best"), ("best", "keep_best"), ("filter_3d",) * 2])
def test_a_state_of_no_part_is_refused_by_its_name(key, name):
    with pytest.raises(UserError, match=f"the checkpoint has a state of {name}, which this code does not have"):
        states_in({key: {}})


def test_hooks_that_are_not_overridden_are_not_called():
    class Counting(Part):
        def stepped(self, at: object) -> None: ...

    parts = [Part(), Counting()]
    assert [hook.__self__ for hook in overrides(parts, "stepped")] == parts[1:] and not overrides(parts, "ended")
