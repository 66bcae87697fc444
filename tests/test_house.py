"""The layout of the code: rooms and what they may import, lengths of functions and files, names that users import."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
COMMANDS = ("train", "render", "metrics", "full_eval", "convert", "doctor", "export", "setup", "view")
ROOMS = (
    *("applications", "arguments", "benchmarks", "gaussian_renderer", "groundwork", "lpipsPyTorch", "scene"),
    *("splatting", "utils"),
)
BENCHMARKS = ("accuracy", "exports", "kernels", "parallel", "peers", "scenes")
CSRC = ROOT / "submodules"
LONGEST = 60  # lines of a function

# The floors of the house, from the top: a room imports itself and the floors below it, never what lies above or beside
# it. A room is all modules whose longest prefix it is.
FLOORS = (
    *(("benchmarks.gate",), tuple(f"benchmarks.{name}" for name in BENCHMARKS), ("benchmarks.harness",)),
    ("benchmarks",),
    COMMANDS,
    ("applications.evaluation", "applications.nerfbaselines", "applications.viewer"),
    ("applications.convert", "applications.demo", "applications.doctor", "applications.export"),
    ("applications",),
    ("splatting.commands",),
    ("splatting.loop",),
    ("splatting.faster", "splatting.log"),
    ("splatting.make_run",),
    ("splatting.plan",),
    ("splatting.run",),
    ("splatting.checks",),
    ("splatting.registry",),
    ("splatting.features",),
    ("splatting",),
    ("splatting.records",),
    ("arguments",),
    ("lpipsPyTorch", "utils.camera_utils", "utils.make_depth_scale"),  # names of the reference for what lies below
    ("scene.checks",),
    ("gaussian_renderer.camera_paths",),
    ("gaussian_renderer",),
    ("scene",),
    ("scene.splats",),
    ("scene.readers",),
    ("scene.colmap_loader", "scene.gaussians", "scene.images"),
    ("utils",),
    ("groundwork.applications", "groundwork.finding"),
    ("groundwork.files",),
    ("groundwork.ranks",),
    ("groundwork.deterministic",),
    ("groundwork.host",),
    ("groundwork",),
)
LEVEL = {room: level for level, floor in enumerate(FLOORS) for room in floor}

# Names that users of the reference import, and what came with them.
UTILS = {
    *("camera_utils", "general_utils", "graphics_utils", "image_utils", "loss_utils", "make_depth_scale"),
    *("lpips_utils", "sh_utils", "system_utils"),
}


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def _python() -> list[Path]:
    """All Python files but tests, as a clone has them."""
    files = [path for room in ROOMS for path in (ROOT / room).rglob("*.py") if "tests" not in path.parts]
    files += [ROOT / f"{name}.py" for name in COMMANDS]
    files += [path for path in CSRC.rglob("*.py") if "build" not in path.relative_to(CSRC).parts]
    return sorted(files)


def _module(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def _within(module: str, room: str) -> bool:
    return module == room or module.startswith(room + ".")


def _room(module: str) -> str:
    return max((room for room in LEVEL if _within(module, room)), key=len)


def _is_module(name: str) -> bool:
    path = ROOT / name.replace(".", "/")
    return path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()


def _for_types(tree: ast.Module) -> set[ast.AST]:
    """Return the nodes under `if TYPE_CHECKING:`, which no program runs."""
    tests = [node for node in ast.walk(tree) if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    return {inner for node in tests for part in node.body for inner in ast.walk(part)}


def _imports(path: Path, types: bool = True) -> Iterator[str]:
    """The project's modules that a file imports; `from a import b` counts as a.b where that is a module."""
    ignored = set() if types else _for_types(_tree(path))
    for node in ast.walk(_tree(path)):
        if node in ignored:
            continue
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if _is_module(name) else node.module for name in names]
        else:
            continue
        yield from (name for name in names if name.split(".")[0] in (*ROOMS, *COMMANDS))


def test_a_module_imports_only_floors_below_it():
    wrong = []
    for path in _python():
        if CSRC in path.parents:
            continue
        room = _room(_module(path))
        for name in _imports(path, types=False):
            if _room(name) != room and LEVEL[_room(name)] <= LEVEL[room]:
                wrong.append(f"{_module(path)} imports {name}")
    assert not wrong


def test_no_modules_import_each_other():
    modules = {_module(path): path for path in _python() if _module(path).split(".")[0] in (*ROOMS, *COMMANDS)}
    graph = {module: set(_imports(path, types=False)) - {module} for module, path in modules.items()}
    while free := [module for module, names in graph.items() if not names & graph.keys()]:
        for module in free:
            del graph[module]
    assert not graph, "these import each other, or import such modules"


def test_extensions_import_nothing_of_the_project():
    for path in CSRC.rglob("*.py"):
        assert not list(_imports(path)), path


def test_utils_has_the_names_of_the_reference_at_its_top():
    assert {path.stem for path in (ROOT / "utils").glob("*.py")} - {"__init__"} == UTILS


def test_an_application_imports_no_other():
    """Require calls by groundwork/applications.py between applications, as each may be deleted."""
    for path in (path for path in _python() if "applications" in path.relative_to(ROOT).parts):
        own = ".".join(path.relative_to(ROOT).parts[:2])
        assert [name for name in _imports(path) if _within(name, "applications") and not _within(name, own)] == [], path


def test_functions_are_short_in_python():
    long = {
        f"{_module(path)}.{node.name}": length
        for path in _python()
        for node in ast.walk(_tree(path))
        if isinstance(node, ast.FunctionDef) and (length := node.end_lineno - node.lineno + 1) > LONGEST
    }
    assert not long


def _csrc() -> list[Path]:
    endings = {".h", ".cpp", ".cu", ".cuh"}
    return [
        path
        for path in CSRC.rglob("*")
        if path.suffix in endings and not {"build", "tests"} & set(path.relative_to(CSRC).parts)
    ]


def test_functions_are_short_in_c_plus_plus():
    """clang-format puts the closing brace of a function at the margin, and besides only those of types."""
    head = r"^(?!namespace|struct|class|enum|union|extern|static_assert)[\w\[<][^\n]*\n(?:[^}\n][^\n]*\n)*?"
    function = re.compile(head + r"(?:(?!})[^\n]*\n)*?}$", re.MULTILINE)
    lengths = {}
    for path in _csrc():
        text = path.read_text(encoding="utf-8")
        for match in function.finditer(text):
            if "{\n" in match[0]:
                line = text[: match.start()].count("\n") + 1
                lengths[f"{path.relative_to(CSRC)}:{line}"] = match[0].count("\n") + 1
    assert len(lengths) > 250
    assert not {place: length for place, length in lengths.items() if length > LONGEST}


# What no feature can pay with: growth goes into applications. Lines are lines of code.
CEILINGS = {
    "lines of the day's list": 6_900,
    "files of the day's list": 55,
    "lines of an iteration": 850,
    "files of an iteration": 6,
    "imports of an iteration beside the day's list": 31,
    "lines of the core": 39_000,
}
NO_CORE = {"applications", "benchmarks", "tests", "emulation"}


def _code_lines(path: Path) -> int:
    """Count the lines that are not blank, comment or docstring."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        text = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
        return sum(bool(re.sub(r"//.*", "", line).strip()) for line in text.splitlines())
    lines = {n for n, line in enumerate(text.splitlines(), 1) if line.strip() and not line.lstrip().startswith("#")}
    for node in ast.walk(_tree(path)):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)) and ast.get_docstring(node, clean=False):
            lines -= {*range(node.body[0].lineno, node.body[0].end_lineno + 1)}
    return len(lines)


def _day() -> list[dict[Path, int]]:
    """Read the groups of files of the day's list, with the lines that it states. The first group is an iteration."""
    page = (ROOT / "docs/inside/architecture.md").read_text(encoding="utf-8")
    groups = re.split(r"^ *[\d,]+  [A-Z].*$", page.partition("## The day's list")[2], flags=re.MULTILINE)[1:]
    found = [re.findall(r"^ *(\d+)    (\S+\.py) ", group, re.MULTILINE) for group in groups]
    return [{ROOT / name: int(lines) for lines, name in group} for group in found]


def test_the_core_does_not_grow():
    iteration, *others = map(list, _day())
    day = [path for group in (iteration, *others) for path in group]
    beside = {name for path in iteration for name in _imports(path, types=False)} - {*map(_module, day)}
    core = [path for path in (*_python(), *_csrc()) if not NO_CORE & set(path.relative_to(ROOT).parts)]
    measured = {
        "lines of the day's list": sum(map(_code_lines, day)),
        "files of the day's list": len(day),
        "lines of an iteration": sum(map(_code_lines, iteration)),
        "files of an iteration": len(iteration),
        "imports of an iteration beside the day's list": len(beside),
        "lines of the core": sum(map(_code_lines, core)),
    }
    assert not {what: f"{count}, above {CEILINGS[what]}" for what, count in measured.items() if count > CEILINGS[what]}


def test_the_list_of_the_day_states_the_lines_of_its_files():
    stated = {path: lines for group in _day() for path, lines in group.items()}
    found = {path: _code_lines(path) for path in stated}
    assert not {path.name: lines for path, lines in found.items() if abs(lines - stated[path]) > 20}


def _includes(path: Path) -> list[str]:
    return re.findall(r'^#include [<"](.+)[>"]', path.read_text(encoding="utf-8"), re.MULTILINE)


def test_the_arithmetic_includes_nothing_above_it():
    headers = list(CSRC.rglob("math/*.h"))
    assert len(headers) > 15
    for path in headers:
        for name in _includes(path):
            own = (path.parent / name).is_file() or name.startswith(("math/", "gs/")) or Path(name).name == "data.h"
            assert own or re.fullmatch(r"c?\w+", name), f"{path.relative_to(CSRC)} includes {name}"


# The phases of csrc/cuda: a file includes its own folder and those before.
PHASES = ("queue", "project", "bin", "blend", "step", "backward", "ranks")
RASTERIZER = CSRC / "diff-gaussian-rasterization"


def test_a_kernel_includes_no_later_phase():
    files = [path for path in _csrc() if RASTERIZER / "csrc" / "cuda" in path.parents]
    assert len(files) > 40
    for path in files:
        for name in _includes(path):
            if name.startswith("cuda/") and name.endswith(".cuh"):
                phases = PHASES[: PHASES.index(path.parent.name) + 1]
                assert name.split("/")[1] in phases, f"{path.relative_to(CSRC)} includes {name}"


def test_the_map_of_csrc_names_its_sources_and_operators():
    map_of_csrc = (RASTERIZER / "csrc" / "README.md").read_text(encoding="utf-8")
    sources = [path for path in _csrc() if RASTERIZER in path.parents and path.suffix in (".cpp", ".cu")]
    sources = [path for path in sources if path.stem not in ("backward", "scene")]  # of all operators
    operators = {name for path in sources for name in re.findall(r'define(?:_for_all)?\(\s*"(\w+)\(', path.read_text())}
    assert len(sources) > 40 and len(operators) > 25
    assert [path.name for path in sources if path.name not in map_of_csrc] == []
    assert sorted(name for name in operators if f"`{name}`" not in map_of_csrc) == []


def test_nothing_needs_the_function_of_gsplat():
    """Its folders can be deleted, with the tests and benchmarks that csrc/README.md names."""
    for path in (path for path in _csrc() if "gsplat" not in path.parts):
        assert not [name for name in _includes(path) if name.startswith("gsplat/")], path
    words = re.compile(r"diff_gaussian_rasterization\.gsplat|\b(?:OPERATORS|ops)\.(?:describe\w*|pinhole)\b")
    for path in (path for path in _python() if not {"gsplat", "benchmarks"} & set(path.parts)):
        assert not words.search(path.read_text(encoding="utf-8")), path
    removed = (RASTERIZER / "csrc" / "README.md").read_text(encoding="utf-8").partition("## Without gsplat's")[2]
    for path in (*ROOT.glob("tests/**/*.py"), *ROOT.glob("benchmarks/**/*.py")):
        if words.search(path.read_text(encoding="utf-8")):
            assert path.name in removed or path == Path(__file__), f"csrc/README.md does not say that {path} uses it"


def test_tensors_are_seen_in_one_folder():
    for path in _csrc():
        if "torch" not in path.relative_to(CSRC).as_posix():
            seen = [name for name in _includes(path) if name.startswith(("torch/", "ATen/", "c10/"))]
            assert not seen, f"{path.relative_to(CSRC)} includes {seen}"


# Words, and the modules and rooms that may say them.
SAID_IN = {
    "torch.ops.diff_gaussian_rasterization": ("submodules", "benchmarks"),
    # Commands run as modules, but for setup.py, whose builder is in no package, and what the reference runs as a file.
    "sys.path": ("submodules", "setup", "utils.make_depth_scale"),
    # What lies above: parts, for a scene that nobody gives any.
    'import_module("splatting': ("scene.scene",),
}


@pytest.mark.parametrize("words", SAID_IN)
def test_one_place_knows(words):
    said = [_module(path) for path in _python() if words in path.read_text(encoding="utf-8")]
    assert [module for module in said if not any(_within(module, place) for place in SAID_IN[words])] == []


@pytest.mark.slow
def test_names_of_the_reference_are_the_same_objects_everywhere():
    code = """
import sys
import scene
assert not [name for name in sys.modules if name.startswith("scene.")]  # imported on first use
import arguments, utils.camera_utils, scene.dataset_readers
from scene import GaussianModel, Scene, cameras
assert scene.cameras is cameras and {"Scene", "cameras"} <= set(dir(scene))
assert scene.gaussian_model.GaussianModel is GaussianModel and Scene.__module__ == "scene.scene"
assert cameras.Camera is utils.camera_utils.Camera and scene.ModelParams is arguments.ModelParams
for name in ("cameraList_from_camInfos", "camera_to_JSON"):
    assert getattr(scene, name) is getattr(utils.camera_utils, name)
assert scene.sceneLoadTypeCallbacks is scene.dataset_readers.sceneLoadTypeCallbacks
"""
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)
    with pytest.raises(ImportError, match="no_such_name"):
        from scene import no_such_name  # noqa: F401


def test_private_tensors_are_read_inside_scene_alone():
    """`pc._opacity` and its like are the model's own; the renderer takes `raw_geometry()`."""
    private = {"_xyz", "_features_dc", "_features_rest", "_scaling", "_rotation", "_opacity"}
    for path in _python():
        if path.relative_to(ROOT).parts[0] not in ("scene", "submodules"):
            found = {node.attr for node in ast.walk(_tree(path)) if isinstance(node, ast.Attribute)} & private
            assert not found, f"{path.relative_to(ROOT)} reads {found}"
